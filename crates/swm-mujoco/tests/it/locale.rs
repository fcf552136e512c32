//! Tests making a model in a process whose locale has a decimal comma, which it writes as glibc's `localedef` does.
#![cfg(all(target_os = "linux", target_env = "gnu"))]
#![allow(unsafe_code, reason = "only the C library sets the locale of a process")]

use std::process::Command;
use swm_core::ResetOptions;
use swm_mujoco::ENVS;

/// The variable of the separate process.
const ALONE: &str = "SWM_TEST_LOCALE";

/// The category of numbers of glibc's German locale, as `localedef` writes it: the decimal comma is at 0x20.
const NUMBERS: &[u8] = b"\x14\x11\x03\x20\x06\0\0\0\x20\0\0\0\x22\0\0\0\x24\0\0\0\x28\0\0\0\x2c\0\0\0\x30\0\0\0\
    ,\0.\0\x03\x03\0\0,\0\0\0.\0\0\0UTF-8\0";

#[test]
fn meshes_are_read_in_a_locale_with_a_decimal_comma() {
    if std::env::var_os(ALONE).is_none() {
        // MuJoCo keeps the meshes that it has read, and tests share a process, so the test runs in a separate one.
        let folder = tempfile::tempdir().expect("a folder");
        let locale = folder.path().join("comma");
        std::fs::create_dir(&locale).expect("creating the folder of the locale");
        std::fs::write(locale.join("LC_NUMERIC"), NUMBERS).expect("writing the locale");
        let test = std::env::current_exe().expect("finding the test program");
        let mut alone = Command::new(test);
        let name = "locale::meshes_are_read_in_a_locale_with_a_decimal_comma";
        // The C library finds its locales in this folder.
        alone.args(["--exact", name]).env(ALONE, "1").env("LOCPATH", folder.path());
        let output = alone.output().expect("running the test program");
        let stdout = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && stdout.contains("1 passed"), "{stdout}");
        return;
    }
    // SAFETY: the name ends with a zero, and no other thread of this process reads or sets the locale.
    let set = unsafe { libc::setlocale(libc::LC_NUMERIC, c"comma".as_ptr()) };
    assert!(!set.is_null(), "the C library does not read the locale");
    let mut env = ENVS.choose("swm/OGBCube-v0").and_then(|entry| entry.env()).expect("creating the environment");
    env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    let mut text = [0_u8; 8];
    // SAFETY: the buffer has the given size; the format has one number.
    unsafe { libc::snprintf(text.as_mut_ptr().cast(), text.len(), c"%.1f".as_ptr(), 0.5_f64) };
    assert_eq!(&text[..3], b"0,5", "the process keeps its locale");
}
