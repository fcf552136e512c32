//! Tests that a program with this crate is not linked with MuJoCo, so that it starts where MuJoCo is not installed.

use std::ops::Range;

/// The section type of the dynamic section of an ELF file.
const DYNAMIC: u64 = 6;
/// The section type of the dynamic symbol table of an ELF file.
const DYNAMIC_SYMBOLS: u64 = 11;
/// The tag of an entry of [`DYNAMIC`] that names a shared library.
const NEEDED: u64 = 1;

/// A 64-bit little-endian ELF file.
struct Elf(Vec<u8>);

impl Elf {
    /// The integer in these bytes.
    fn integer(&self, at: Range<usize>) -> u64 {
        self.0[at].iter().rev().fold(0, |integer, &byte| integer << 8 | u64::from(byte))
    }

    /// The integer in these bytes, as an offset or size.
    fn offset(&self, at: Range<usize>) -> usize {
        usize::try_from(self.integer(at)).expect("converting an offset")
    }

    /// The offset of the header of section `i`.
    fn header(&self, i: usize) -> usize {
        let (first, size) = (self.offset(0x28..0x30), self.offset(0x3a..0x3c));
        first + i * size
    }

    /// The offsets of the entries of all sections of a type, each with the offset of its string table.
    fn entries(&self, section_type: u64) -> Vec<(usize, usize)> {
        let sections = self.offset(0x3c..0x3e);
        let of_type = (0..sections).map(|i| self.header(i)).filter(|at| self.integer(at + 4..at + 8) == section_type);
        let entries = of_type.flat_map(|at| {
            let strings = self.header(self.offset(at + 0x28..at + 0x2c));
            let strings = self.offset(strings + 0x18..strings + 0x20);
            let (first, size) = (self.offset(at + 0x18..at + 0x20), self.offset(at + 0x20..at + 0x28));
            let entry_size = self.offset(at + 0x38..at + 0x40);
            (first..first + size).step_by(entry_size).map(move |entry| (entry, strings))
        });
        entries.collect()
    }

    /// The zero-terminated text at an offset.
    fn text(&self, at: usize) -> String {
        String::from_utf8_lossy(self.0[at..].split(|&byte| byte == 0).next().unwrap_or_default()).into_owned()
    }
}

#[test]
fn mujoco_is_not_linked() {
    let elf = Elf(std::fs::read("/proc/self/exe").expect("reading the test program"));
    assert_eq!(elf.0[..5], *b"\x7fELF\x02");
    let is_mujoco = |name: &String| ["mj_", "mjv_", "mjr_", "mju_", "mjs_"].iter().any(|head| name.starts_with(head));
    let symbols = elf.entries(DYNAMIC_SYMBOLS);
    let names: Vec<String> = symbols.iter().map(|&(at, strings)| elf.text(strings + elf.offset(at..at + 4))).collect();
    assert!(names.iter().any(|name| name == "malloc"), "`malloc` is not in the symbol table");
    assert_eq!(names.iter().find(|name| is_mujoco(name)), None, "a symbol of MuJoCo is imported or exported");
    let needed = elf.entries(DYNAMIC).into_iter().filter(|&(at, _)| elf.integer(at..at + 8) == NEEDED);
    let libraries: Vec<String> = needed.map(|(at, strings)| elf.text(strings + elf.offset(at + 8..at + 16))).collect();
    assert!(libraries.iter().any(|name| name.starts_with("libc.so")), "{libraries:?}");
    assert!(!libraries.iter().any(|name| name.contains("mujoco")), "{libraries:?}");
}
