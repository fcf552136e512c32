//! Arguments that several commands share: image codecs, factors of variation, frame sizes.

use clap::{Args, ValueEnum};
use std::collections::BTreeMap;
use swm_core::{Error, Result, VariationRequest};
use swm_data::{FORMATS, ImageCodec, Location};

/// The codec of stored frames, for formats that support several codecs.
#[derive(Args, Clone, Default)]
pub struct CodecArgs {
    /// Codec of stored frames, in formats with several codecs (default: qoi)
    #[arg(long, value_enum)]
    codec: Option<Codec>,
    /// Quality of JPEG frames, 1 to 100 (default: 95)
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=100))]
    quality: Option<u8>,
}

/// The quality of JPEG frames, unless the command line says otherwise.
const JPEG_QUALITY: u8 = 95;

/// The codec of stored frames.
#[derive(Clone, Copy, ValueEnum)]
enum Codec {
    /// Lossless; the fastest
    Qoi,
    /// Lossless; the most compatible
    Png,
    /// Lossy; the codec of the reference implementation
    Jpeg,
}

impl Codec {
    /// The name on the command line.
    fn name(self) -> &'static str {
        match self {
            Self::Qoi => "qoi",
            Self::Png => "png",
            Self::Jpeg => "jpeg",
        }
    }
}

impl CodecArgs {
    /// Checks that a codec that is chosen has an effect in the dataset's format; `format` is its id, if the command names it.
    ///
    /// # Errors
    /// When the format stores frames without loss and has no codecs, or stores videos and the codec is one of single images.
    pub fn check_format(&self, location: &Location, format: Option<&str>) -> Result<()> {
        let entry = match format {
            Some(id) => Some(FORMATS.get(id)?),
            None => FORMATS.rows.iter().find(|entry| (entry.detect)(location)),
        };
        let (Some(entry), Some(codec)) = (entry, self.codec) else { return Ok(()) };
        let is_lossy = matches!(codec, Codec::Jpeg);
        let problem = match (entry.codecs, entry.exact_images) {
            (false, _) => format!("the format {} stores frames without loss, in a way of its own", entry.id),
            (true, false) if !is_lossy => format!("the format {} stores videos, without loss by default", entry.id),
            (true, _) => return Ok(()),
        };
        let fix = if entry.codecs { "leave it out, or choose jpeg" } else { "leave it out, or choose another format" };
        Err(Error::config(format!("--codec {}", codec.name()), problem, fix))
    }

    /// Returns the codec with its quality.
    ///
    /// # Errors
    /// When a quality is given for a codec without one.
    pub fn codec(&self) -> Result<ImageCodec> {
        match (self.codec, self.quality) {
            (Some(Codec::Jpeg), quality) => Ok(ImageCodec::Jpeg { quality: quality.unwrap_or(JPEG_QUALITY) }),
            (_, Some(_)) => {
                Err(Error::config("--quality", "only JPEG frames have one", "add --codec jpeg, or leave it out"))
            }
            (Some(Codec::Qoi) | None, None) => Ok(ImageCodec::Qoi),
            (Some(Codec::Png), None) => Ok(ImageCodec::Png),
        }
    }

    /// Returns these arguments, with those of `recorded` where none are given.
    pub fn or(&self, recorded: &Self) -> Self {
        match self.codec {
            Some(_) => self.clone(),
            None => Self { codec: recorded.codec, quality: self.quality.or(recorded.quality) },
        }
    }
}

/// Factors of variation to sample or to pin.
#[derive(Args, Clone, Default)]
pub struct VariationArgs {
    /// Factors to sample at every reset: keys, groups, `all` or `none`
    ///
    /// A group is the first part of a key, such as `agent` of `agent.color`. These replace the factors that the environment samples by
    /// itself, such as the start: name those as well (`swm fovs` marks them), or all episodes start alike.
    #[arg(long, value_name = "KEY", num_args = 1.., value_delimiter = ',')]
    pub variation: Option<Vec<String>>,
    /// Factors to set to a value, such as background.color=200,220,255
    #[arg(long, value_name = "KEY=VALUE", num_args = 1..)]
    pub pin: Vec<String>,
}

impl VariationArgs {
    /// Returns the factors of variation for every reset.
    ///
    /// # Errors
    /// When a pinned value is not `KEY=NUMBER[,NUMBER…]` with finite numbers, or a factor is pinned twice.
    pub fn request(&self) -> Result<VariationRequest> {
        let mut variation_values = BTreeMap::new();
        for pin in &self.pin {
            let (key, values) = pinned("--pin", pin)?;
            if variation_values.insert(key.to_owned(), values).is_some() {
                let is_first = |other: &&String| other.split_once('=').is_some_and(|(other, _)| other == key);
                let first = self.pin.iter().find(is_first).unwrap_or(pin);
                return Err(Error::twice(format!("--pin {key}"), first, pin));
            }
        }
        let variation = self.variation.as_ref().map(|keys| match &keys[..] {
            [none] if none == "none" => vec![],
            keys => keys.to_vec(),
        });
        Ok(VariationRequest { variation, variation_values })
    }

    /// Returns these factors and one more: `KEY=VALUE` to set it, `KEY` to sample it. `by_default` are the factors that are
    /// sampled where none are given.
    ///
    /// # Errors
    /// When the value is not numbers.
    pub fn with(&self, shift: &str, by_default: &[String]) -> Result<Self> {
        let mut all = self.clone();
        if shift.contains('=') {
            pinned("--shift", shift)?;
            all.pin.push(shift.to_owned());
        } else {
            let keys = all.variation.get_or_insert_with(|| by_default.to_vec());
            keys.retain(|key| key != "none");
            keys.push(shift.to_owned());
        }
        Ok(all)
    }

    /// Returns a short description of the shift.
    pub fn describe(&self) -> String {
        let varied = self.variation.iter().flatten().map(|key| format!("{key} sampled"));
        let shifts: Vec<String> = varied.chain(self.pin.iter().cloned()).collect();
        if shifts.is_empty() { "in distribution".to_owned() } else { shifts.join(", ") }
    }
}

/// Parses the key and the values of a pinned factor, which an option gives.
///
/// # Errors
/// When it is not `KEY=NUMBER[,NUMBER…]` with finite numbers.
fn pinned<'a>(option: &str, given: &'a str) -> Result<(&'a str, Vec<f64>)> {
    let parse = |value: &str| value.trim().parse().ok().filter(|value: &f64| value.is_finite());
    let found = given.split_once('=').and_then(|(key, values)| {
        let values: Option<Vec<f64>> = values.split(',').map(parse).collect();
        Some((key, values?))
    });
    found.ok_or_else(|| {
        let fix = "write it like background.color=200,220,255";
        Error::config(format!("{option} {given}"), "it is not KEY=NUMBER[,NUMBER…]", fix)
    })
}

/// Parses a count from `LOW` to `HIGH`. An absurd count would otherwise take all memory before any check.
///
/// # Errors
/// When it is not such a count.
pub fn count<const LOW: usize, const HIGH: usize>(given: &str) -> std::result::Result<usize, String> {
    let count = given.parse::<usize>().ok().filter(|count| (LOW..=HIGH).contains(count));
    count.ok_or_else(|| format!("'{given}' is not a whole number from {LOW} to {HIGH}"))
}

/// Parses the seconds of a measurement, at most an hour.
///
/// # Errors
/// When they are not a positive number of at most 3600.
pub fn seconds(given: &str) -> std::result::Result<f64, String> {
    let seconds = given.parse::<f64>().ok().filter(|seconds| *seconds > 0.0 && *seconds <= 3600.0);
    seconds.ok_or_else(|| format!("'{given}' is not a number of seconds above 0 and at most 3600"))
}

/// Parses a frame size in pixels: `64` or `HEIGHTxWIDTH`.
///
/// # Errors
/// When the text is malformed or a side is not within 4 to 4096.
pub fn image_size(given: &str) -> std::result::Result<(usize, usize), String> {
    let parse = |s: &str| s.trim().parse::<usize>().ok().filter(|n| (4..=swm_core::limits::IMAGE_SIDE.max).contains(n));
    let size = match given.split_once('x') {
        Some((height, width)) => parse(height).zip(parse(width)),
        None => parse(given).map(|n| (n, n)),
    };
    size.ok_or_else(|| format!("'{given}' is not a frame size: write 64 or 64x96 (height x width), from 4 to 4096"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codecs_without_effect_are_refused() {
        let check = |codec, name: &str| {
            let location = Location::Path(name.into());
            CodecArgs { codec, quality: None }.check_format(&location, None).map_err(|error| error.to_string())
        };
        for (name, part) in [("a.video", "stores videos"), ("a.lerobot", "stores videos"), ("a.h5", "without loss")] {
            for codec in [Codec::Png, Codec::Qoi] {
                let error = check(Some(codec), name).expect_err(name);
                assert!(error.contains(&format!("--codec {}", codec.name())) && error.contains(part), "{error}");
            }
            check(None, name).expect(name);
        }
        check(Some(Codec::Jpeg), "a.video").expect("the quality of a video");
        check(Some(Codec::Jpeg), "a.h5").expect_err("a format without codecs");
        check(Some(Codec::Png), "a.lance").expect("a format of single images");
    }

    #[test]
    fn parses_variation_and_frame_sizes() {
        let args = VariationArgs {
            variation: Some(vec!["agent".to_owned()]),
            pin: vec!["background.color=1, 2,3".to_owned()],
        };
        let request = args.request().expect("parsing the request");
        assert_eq!(request.variation_values["background.color"], [1.0, 2.0, 3.0]);
        assert_eq!(args.describe(), "agent sampled, background.color=1, 2,3");
        let none = VariationArgs { variation: Some(vec!["none".to_owned()]), pin: vec![] };
        assert_eq!(none.request().expect("parsing the request").variation, Some(vec![]));
        let twice = ["agent.x=1", "agent.y=1", "agent.x=2"].map(str::to_owned).to_vec();
        let twice = VariationArgs { variation: None, pin: twice }
            .request()
            .expect_err("a factor that is given twice")
            .to_string();
        assert!(twice.contains("--pin agent.x: is given twice: 'agent.x=1' and 'agent.x=2'"), "{twice}");
        let wrong = VariationArgs { variation: None, pin: vec!["background.color".to_owned()] };
        assert!(wrong.request().expect_err("a pin without a value").to_string().contains("background.color=200"));
        let keys = ["agent.position".to_owned()];
        let all = VariationArgs::default().with("block", &keys).expect("a shift").variation;
        assert_eq!(all, Some(vec!["agent.position".to_owned(), "block".to_owned()]));
        let none = VariationArgs { variation: Some(vec!["none".to_owned()]), pin: vec![] };
        assert_eq!(none.with("agent", &keys).expect("a shift").variation, Some(vec!["agent".to_owned()]));
        assert_eq!(
            args.with("agent.scale=3", &keys).expect("a shift").with("block", &keys).expect("a shift").describe(),
            "agent sampled, block sampled, background.color=1, 2,3, agent.scale=3"
        );
        assert_eq!(image_size("64x96"), Ok((64, 96)));
        assert!(image_size("3").is_err());
        assert_eq!((count::<1, 9>("9"), seconds("0.5")), (Ok(9), Ok(0.5)));
        assert!(["0", "10", "-1", "nan", "", "1e3"].into_iter().all(|given| count::<1, 9>(given).is_err()));
        assert!(["0", "-1", "nan", "inf", "3601"].into_iter().all(|given| seconds(given).is_err()));
    }
}
