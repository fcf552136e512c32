//! Colours of pinned factors: `hsv(HUE,SATURATION,VALUE)` as red, green and blue.

use swm_core::{Error, Result};

/// Replaces `hsv(…)` in `KEY=hsv(HUE,SATURATION,VALUE)` by three bytes. Hue is in degrees, saturation and value from 0 to 1.
///
/// # Errors
/// When the colour does not have three numbers, or saturation or value is outside 0 to 1. `at` is named in the error.
pub fn resolve(pin: &str, at: &str) -> Result<String> {
    let Some((key, inside)) = pin.strip_suffix(')').and_then(|pin| pin.split_once("=hsv(")) else {
        return Ok(pin.to_owned());
    };
    let numbers: Vec<f64> = inside.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    match numbers[..] {
        [hue, saturation, value]
            if hue.is_finite() && (0.0..=1.0).contains(&saturation) && (0.0..=1.0).contains(&value) =>
        {
            let [red, green, blue] = rgb(hue, saturation, value);
            Ok(format!("{key}={red},{green},{blue}"))
        }
        _ => {
            let fix = "write hsv(HUE,SATURATION,VALUE) with a hue in degrees, and saturation and value from 0 to 1";
            Err(Error::config(format!("{at}: {pin}"), "is not a colour", fix))
        }
    }
}

/// Converts a colour (Smith, "Color gamut transform pairs", 1978).
fn rgb(hue: f64, saturation: f64, value: f64) -> [u8; 3] {
    let channel = |offset: f64| {
        let k = (offset + hue.rem_euclid(360.0) / 60.0) % 6.0;
        let level = value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0);
        (255.0 * level).round() as u8
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_those_of_pythons_colorsys() {
        // colorsys.hsv_to_rgb(hue / 360, saturation, value), times 255.
        for (hue, saturation, value, expected) in [
            (0.0, 1.0, 1.0, [255, 0, 0]),
            (120.0, 1.0, 1.0, [0, 255, 0]),
            (240.0, 0.5, 1.0, [128, 128, 255]),
            (60.0, 0.25, 0.8, [204, 204, 153]),
            (300.0, 1.0, 0.5, [128, 0, 128]),
            (33.0, 0.0, 1.0, [255, 255, 255]),
        ] {
            assert_eq!(rgb(hue, saturation, value), expected, "{hue} {saturation} {value}");
        }
        let resolved = resolve("background.color=hsv(0, 1, 1)", "file").expect("a colour");
        assert_eq!(resolved, "background.color=255,0,0");
        assert_eq!(resolve("agent.scale=3", "file").expect("a number"), "agent.scale=3");
        assert!(
            resolve("a=hsv(0,2,1)", "study.toml:3")
                .expect_err("a saturation of 2")
                .to_string()
                .contains("study.toml:3")
        );
    }
}
