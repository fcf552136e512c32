//! This program uses MuJoCo and starts without it: the linker was told of no MuJoCo.

use std::ops::Range;

/// Sections of an ELF file that matter here, by their type.
const DYNAMIC: u64 = 6;
const DYNAMIC_SYMBOLS: u64 = 11;
/// The tag of an entry of [`DYNAMIC`] that names a library to load at the start.
const NEEDED: u64 = 1;

/// An ELF file of 64 bits, little endian.
struct Elf(Vec<u8>);

impl Elf {
    /// The number in these bytes.
    fn number(&self, at: Range<usize>) -> u64 {
        self.0[at].iter().rev().fold(0, |number, &byte| number << 8 | u64::from(byte))
    }

    fn place(&self, at: Range<usize>) -> usize {
        usize::try_from(self.number(at)).expect("a place in the file")
    }

    /// The head of section `i`.
    fn head(&self, i: usize) -> usize {
        let (first, size) = (self.place(0x28..0x30), self.place(0x3a..0x3c));
        first + i * size
    }

    /// The entries of the sections of a type, each with the place of the strings that belong to them.
    fn entries(&self, wanted: u64) -> Vec<(usize, usize)> {
        let sections = self.place(0x3c..0x3e);
        let of_type = (0..sections).map(|i| self.head(i)).filter(|at| self.number(at + 4..at + 8) == wanted);
        let entries = of_type.flat_map(|at| {
            let strings = self.head(self.place(at + 0x28..at + 0x2c));
            let strings = self.place(strings + 0x18..strings + 0x20);
            let (first, size, each) =
                (self.place(at + 0x18..at + 0x20), self.place(at + 0x20..at + 0x28), self.place(at + 0x38..at + 0x40));
            (first..first + size).step_by(each).map(move |entry| (entry, strings))
        });
        entries.collect()
    }

    /// The text that begins there.
    fn text(&self, at: usize) -> String {
        String::from_utf8_lossy(self.0[at..].split(|&byte| byte == 0).next().unwrap_or_default()).into_owned()
    }
}

#[test]
fn nothing_of_mujoco_is_linked() {
    let elf = Elf(std::fs::read("/proc/self/exe").expect("this program"));
    assert_eq!(elf.0[..5], *b"\x7fELF\x02");
    let of_mujoco = |name: &String| ["mj_", "mjv_", "mjr_", "mju_", "mjs_"].iter().any(|head| name.starts_with(head));
    let symbols = elf.entries(DYNAMIC_SYMBOLS);
    let names: Vec<String> = symbols.iter().map(|&(at, strings)| elf.text(strings + elf.place(at..at + 4))).collect();
    assert!(names.iter().any(|name| name == "malloc"), "the symbols that the C library brings are found");
    assert_eq!(names.iter().find(|name| of_mujoco(name)), None, "neither taken from elsewhere nor offered");
    let needed = elf.entries(DYNAMIC).into_iter().filter(|&(at, _)| elf.number(at..at + 8) == NEEDED);
    let libraries: Vec<String> = needed.map(|(at, strings)| elf.text(strings + elf.place(at + 8..at + 16))).collect();
    assert!(libraries.iter().any(|name| name.starts_with("libc.so")), "{libraries:?}");
    assert!(!libraries.iter().any(|name| name.contains("mujoco")), "{libraries:?}");
}
