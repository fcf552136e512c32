//! Words of the command line that several commands share.

use clap::{Args, ValueEnum};
use std::collections::BTreeMap;
use swm_core::{Error, Result, VariationRequest};
use swm_data::ImageCodec;

/// How pictures are stored, where the format leaves a choice.
#[derive(Args)]
pub struct CodecArgs {
    /// How pictures are stored, where the format leaves a choice
    #[arg(long, value_enum, default_value_t = Codec::Qoi)]
    codec: Codec,
    /// Quality of jpeg, 1 to 100
    #[arg(long, default_value_t = 95, value_parser = clap::value_parser!(u8).range(1..=100))]
    quality: u8,
}

/// How pictures are stored.
#[derive(Clone, Copy, ValueEnum)]
enum Codec {
    /// Lossless, the fastest
    Qoi,
    /// Lossless, read by everything
    Png,
    /// Lossy, what the reference writes
    Jpeg,
}

impl CodecArgs {
    /// What they ask for.
    pub fn codec(&self) -> ImageCodec {
        match self.codec {
            Codec::Qoi => ImageCodec::Qoi,
            Codec::Png => ImageCodec::Png,
            Codec::Jpeg => ImageCodec::Jpeg { quality: self.quality },
        }
    }
}

/// Which factors of variation differ between episodes.
#[derive(Args, Clone, Default)]
pub struct VariationArgs {
    /// Factors to sample at every reset: keys, groups such as `agent`, or `all`; `none` samples nothing
    #[arg(long, value_name = "KEY", num_args = 1.., value_delimiter = ',')]
    pub variation: Option<Vec<String>>,
    /// Factors held at a value, such as background.color=200,220,255
    #[arg(long, value_name = "KEY=VALUE", num_args = 1..)]
    pub pin: Vec<String>,
}

impl VariationArgs {
    /// What an environment is asked at a reset.
    pub fn request(&self) -> Result<VariationRequest> {
        let mut variation_values = BTreeMap::new();
        for pin in &self.pin {
            let wrong = || {
                Error::config(
                    format!("--pin {pin}"),
                    "this is not KEY=NUMBER[,NUMBER…]",
                    "write it like background.color=200,220,255",
                )
            };
            let (key, values) = pin.split_once('=').ok_or_else(wrong)?;
            let values: std::result::Result<Vec<f64>, _> = values.split(',').map(|v| v.trim().parse()).collect();
            variation_values.insert(key.to_owned(), values.map_err(|_| wrong())?);
        }
        let variation = self.variation.as_ref().map(|keys| match &keys[..] {
            [none] if none == "none" => vec![],
            keys => keys.to_vec(),
        });
        Ok(VariationRequest { variation, variation_values })
    }

    /// The shift in a few words.
    pub fn describe(&self) -> String {
        let varied = self.variation.iter().flatten().map(|key| format!("{key} sampled"));
        let words: Vec<String> = varied.chain(self.pin.iter().cloned()).collect();
        if words.is_empty() { "in distribution".to_owned() } else { words.join(", ") }
    }
}

/// Parses a picture size: `64` or `HEIGHTxWIDTH`.
pub fn image_size(given: &str) -> std::result::Result<(usize, usize), String> {
    let parse = |s: &str| s.trim().parse::<usize>().ok().filter(|n| (4..=4096).contains(n));
    let size = match given.split_once('x') {
        Some((height, width)) => parse(height).zip(parse(width)),
        None => parse(given).map(|n| (n, n)),
    };
    size.ok_or_else(|| format!("'{given}' is no picture size: write 64 or 64x96 (height x width), from 4 to 4096"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pins_and_keys_become_a_request() {
        let args = VariationArgs {
            variation: Some(vec!["agent".to_owned()]),
            pin: vec!["background.color=1, 2,3".to_owned()],
        };
        let request = args.request().expect("a request");
        assert_eq!(request.variation_values["background.color"], [1.0, 2.0, 3.0]);
        assert_eq!(args.describe(), "agent sampled, background.color=1, 2,3");
        let none = VariationArgs { variation: Some(vec!["none".to_owned()]), pin: vec![] };
        assert_eq!(none.request().expect("a request").variation, Some(vec![]));
        let wrong = VariationArgs { variation: None, pin: vec!["background.color".to_owned()] };
        assert!(wrong.request().expect_err("no value").to_string().contains("background.color=200"));
        assert_eq!(image_size("64x96"), Ok((64, 96)));
        assert!(image_size("3").is_err());
    }
}
