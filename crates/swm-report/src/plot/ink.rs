//! The colours of drawings: each is a variable of the style sheet, so that a drawing follows the theme of the page.

use plotters::style::RGBColor;
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// A colour of a drawing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ink {
    /// Names and values.
    Text,
    /// Axes and notes.
    Soft,
    /// Lines of a grid.
    Grid,
    /// The background.
    Surface,
    /// The random-policy floor.
    Floor,
    /// The expert.
    Expert,
    /// Episodes that were solved.
    Good,
    /// Episodes that were not solved.
    Bad,
    /// A policy, by its index among the policies of the page.
    Policy(usize),
    /// A fixed colour: part of the data, equal in both themes.
    Fixed(u8, u8, u8),
}

/// The number of different colours of policies.
pub(crate) const POLICIES: usize = 8;

/// The variables of the style sheet and their values in the light theme.
const VARIABLES: [(&str, [u8; 3]); 8 + POLICIES] = [
    ("ink", [0x1b, 0x24, 0x30]),
    ("soft", [0x5a, 0x66, 0x75]),
    ("grid", [0xe9, 0xec, 0xf0]),
    ("surface", [0xff, 0xff, 0xff]),
    ("floor", [0x7d, 0x87, 0x94]),
    ("expert", [0x8a, 0x5a, 0x00]),
    ("good", [0x0a, 0x6e, 0x45]),
    ("bad", [0xa8, 0x32, 0x1f]),
    ("c0", [0x0b, 0x62, 0xc4]),
    ("c1", [0xb5, 0x46, 0x0f]),
    ("c2", [0x0a, 0x7d, 0x5a]),
    ("c3", [0x9a, 0x2f, 0x8f]),
    ("c4", [0x7a, 0x6a, 0x00]),
    ("c5", [0x4b, 0x4f, 0xc7]),
    ("c6", [0x00, 0x7a, 0x94]),
    ("c7", [0xb3, 0x22, 0x4f]),
];

impl Ink {
    /// Black or white, whichever is legible on a fixed colour. Neither is a colour of the theme.
    pub(crate) fn on(fill: RGBColor) -> Self {
        // The relative luminance of sRGB, without its gamma: enough to choose between two.
        let light = 0.299 * f64::from(fill.0) + 0.587 * f64::from(fill.1) + 0.114 * f64::from(fill.2);
        if light > 140.0 { Self::Fixed(0x10, 0x10, 0x10) } else { Self::Fixed(0xfe, 0xfe, 0xfe) }
    }

    /// The value in the light theme, which drawings contain.
    pub(crate) fn rgb(self) -> RGBColor {
        let index = match self {
            Self::Text => 0,
            Self::Soft => 1,
            Self::Grid => 2,
            Self::Surface => 3,
            Self::Floor => 4,
            Self::Expert => 5,
            Self::Good => 6,
            Self::Bad => 7,
            Self::Policy(index) => 8 + index % POLICIES,
            Self::Fixed(red, green, blue) => return RGBColor(red, green, blue),
        };
        let [red, green, blue] = VARIABLES[index].1;
        RGBColor(red, green, blue)
    }

    /// The class of the colour in the style sheet, for swatches beside texts.
    pub(crate) fn class(self) -> String {
        match self {
            Self::Expert => "expert".to_owned(),
            Self::Policy(index) => format!("c{}", index % POLICIES),
            _ => "floor".to_owned(),
        }
    }
}

/// The colours of policies, in the order in which a page first names them. One policy has one colour in the whole page.
pub(crate) fn inks<'a>(policies: impl IntoIterator<Item = &'a str>) -> BTreeMap<&'a str, Ink> {
    let (mut inks, mut others) = (BTreeMap::new(), 0);
    for policy in policies {
        inks.entry(policy).or_insert_with(|| match policy {
            "random" => Ink::Floor,
            "expert" => Ink::Expert,
            _ => {
                others += 1;
                Ink::Policy(others - 1)
            }
        });
    }
    inks
}

/// Rules of a style sheet that replace the colours of drawings by its variables. Attributes of an SVG element give way to
/// rules, so one drawing serves the light theme, the dark theme and print.
pub(crate) fn theme_rules() -> String {
    let mut rules = String::new();
    for (name, [red, green, blue]) in VARIABLES {
        let _ = writeln!(
            rules,
            ".chart [fill=\"#{red:02X}{green:02X}{blue:02X}\"] {{ fill: var(--{name}); }} \
             .chart [stroke=\"#{red:02X}{green:02X}{blue:02X}\"] {{ stroke: var(--{name}); }}"
        );
    }
    rules
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_policy_has_one_colour() {
        let given = inks(["random", "a", "b", "a", "expert", "c"]);
        let expected = [Ink::Floor, Ink::Policy(0), Ink::Policy(1), Ink::Expert, Ink::Policy(2)];
        assert_eq!(["random", "a", "b", "expert", "c"].map(|name| given[name]), expected);
    }

    #[test]
    fn colours_are_those_of_the_style_sheet() {
        let light = include_str!("../style.css").split('}').next().expect("the first rule");
        for (name, [red, green, blue]) in VARIABLES {
            let value = format!("--{name}: #{red:02x}{green:02x}{blue:02x}");
            assert!(light.contains(&value), "{value}");
        }
    }
}
