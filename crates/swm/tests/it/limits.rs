//! Tests of absurd counts and of runs with little memory (docs/security.md).

use crate::{Swm, text};
use std::process::{Command, Output};
#[cfg(target_os = "linux")]
use std::sync::mpsc::RecvTimeoutError;

const ROOMS: &[&str] = &["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "1", "--image", "32"];
const EVAL: &[&str] = &["eval", "random", "--env", "swm/TwoRoom-v1", "--image", "32"];

#[test]
fn absurd_counts_are_refused_before_work_starts() {
    let swm = Swm::new();
    let huge = "1000000000000000";
    for (args, option, value, what) in [
        (ROOMS, "--envs", "1000000", "number of environments"),
        (ROOMS, "--threads", "100000", "number of threads"),
        (ROOMS, "--max-steps", huge, "number of steps"),
        (ROOMS, "--shard", "0/1000000000000000", "number of shards"),
        (EVAL, "--budget", huge, "number of steps"),
        (EVAL, "--threads", huge, "number of threads"),
    ] {
        swm.fails(&[args, &[option, value]].concat(), 2, &[what, "too large", "choose at most"]);
    }
    swm.fails(&[&ROOMS[..6], &["--image", "100000"]].concat(), 2, &["100000", "4096"]);
    swm.fails(&[&ROOMS[..6], &["--image", "4096", "--envs", "10000"]].concat(), 2, &["bytes of a batch"]);
    swm.fails(&[&ROOMS[..4], &["--episodes", huge]].concat(), 2, &[huge, "a whole number from 1 to 1000000000"]);
    swm.fails(&[EVAL, &["--episodes", huge]].concat(), 2, &[huge, "from 1 to 1000000"]);
    let wrappers = ["--wrapper", "noise"].repeat(20_000);
    swm.fails(&[&ROOMS[..6], &wrappers].concat(), 2, &["number of wrappers", "20000 is too large"]);
    swm.fails(&[EVAL, &wrappers].concat(), 2, &["number of wrappers", "20000 is too large"]);
    swm.fails(&["bench", "data", "--episodes", "1000000", "--steps", "1000000"], 2, &["bytes of the frames"]);
    swm.fails(&["bench", "envs", "swm/TwoRoom-v1", "--episodes", "1000000"], 2, &["bytes of the frames"]);
    assert!(!swm.path("datasets/rooms.lance").exists());
}

#[test]
fn variables_of_libraries_are_checked() {
    let swm = Swm::new();
    for (name, value) in [
        ("LANCE_IO_THREADS", "abc"),
        ("LANCE_CPU_THREADS", "0"),
        ("LANCE_MAX_IOP_SIZE", "0"),
        ("RAYON_NUM_THREADS", "20000"),
        ("RUST_MIN_STACK", "1"),
    ] {
        let output = swm.command(ROOMS).env(name, value).output().expect("swm runs");
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{name}: {error}");
        assert!(error.contains(name) && error.contains(value) && !error.contains("internal error"), "{error}");
    }
}

/// Runs the command with a limit of its virtual memory, and ends it after a minute.
#[cfg(target_os = "linux")]
fn run_with_memory(swm: &Swm, args: &[&str], kilobytes: usize, stack: &str) -> Output {
    let program = env!("CARGO_BIN_EXE_swm");
    Command::new("sh")
        .args(["-c", &format!("ulimit -v {kilobytes}; exec timeout -s KILL 60 '{program}' \"$@\""), "sh"])
        .args(args)
        .envs([("STABLEWM_HOME", swm.home().as_os_str()), ("RUST_BACKTRACE", "1".as_ref())])
        .env("RUST_MIN_STACK", stack)
        .current_dir(swm.home())
        .output()
        .expect("sh starts")
}

/// Every thread reserves a stack of 1 GiB, so the limit is the number of threads that the program can start, while
/// small allocations succeed. A thread after the first of a runtime that could not be started made the run wait for ever.
#[cfg(target_os = "linux")]
#[test]
fn run_without_threads_ends_with_an_error() {
    const STACK: usize = 1 << 30;
    let swm = Swm::new();
    let two = |args: &[&'static str]| [args, &["--threads", "2"]].concat();
    let collect = |name| two(&["collect", "swm/TwoRoom-v1", "-o", name, "--image", "32", "--episodes", "2"]);
    swm.json(&collect("rooms"));
    for args in [collect("more"), two(&["convert", "rooms", "rooms.h5"]), two(&["doctor", "rooms"])] {
        let (mut outcomes, mut last) = (vec![], String::new());
        // The last run has enough for every thread and for what the system's allocator reserves for each.
        for threads in (0..16).chain([64]) {
            let _absent = std::fs::remove_dir_all(swm.path("datasets/more.lance"));
            let _absent = std::fs::remove_file(swm.path("rooms.h5"));
            let output = run_with_memory(&swm, &args, (threads * STACK + (STACK >> 1)) >> 10, &STACK.to_string());
            let (code, error) = (output.status.code(), text(&output.stderr));
            assert!(matches!(code, Some(0 | 1)), "{args:?} with {threads} threads: {:?}: {error}", output.status);
            assert!(code == Some(0) || error.contains("error: "), "{args:?} with {threads} threads: {error}");
            outcomes.push(code);
            last = error;
        }
        assert_eq!((outcomes[0], outcomes[16]), (Some(1), Some(0)), "{args:?}: {outcomes:?}: {last}");
    }
}

/// With little memory, threads cannot be started and allocations fail anywhere. With backtraces on, the program waited
/// forever for the lock of the backtrace of another panic.
#[cfg(target_os = "linux")]
#[test]
fn run_without_memory_ends_with_an_error() {
    let swm = Swm::new();
    for (i, kilobytes) in (300_000..=700_000).step_by(40_000).enumerate() {
        let name = format!("rooms-{i}");
        let collect = ["collect", "swm/TwoRoom-v1", "-o", &name, "--image", "96", "--episodes", "12", "--threads", "2"];
        let output = run_with_memory(&swm, &collect, kilobytes, "");
        let code = output.status.code();
        assert!(matches!(code, Some(0 | 1)), "{kilobytes} kB: {:?}: {}", output.status, text(&output.stderr));
    }
}

/// The threads that decode and hash are those of rayon's global pool, which panics where it cannot start them at its first use.
#[cfg(target_os = "linux")]
#[test]
fn inspection_without_threads_ends_with_an_error() {
    const STACK: usize = 1 << 30;
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "32", "--episodes", "2"]);
    let inspect = ["inspect", "rooms", "--checksum", "--threads", "2"];
    let outcomes = (0..16).chain([64]).map(|threads| {
        let output = run_with_memory(&swm, &inspect, (threads * STACK + (STACK >> 1)) >> 10, &STACK.to_string());
        let (code, error) = (output.status.code(), text(&output.stderr));
        assert!(matches!(code, Some(0 | 1)), "{threads} threads: {:?}: {error}", output.status);
        assert!(!error.contains("the command panicked"), "{threads} threads: {error}");
        code
    });
    let outcomes: Vec<_> = outcomes.collect();
    assert_eq!((outcomes[0], outcomes[16]), (Some(1), Some(0)), "{outcomes:?}");
    // One thread is enough for a file of HDF5.
    swm.json(&["convert", "rooms", "rooms.h5"]);
    let inspect = ["inspect", "rooms.h5", "--checksum", "--threads", "64"];
    let output = run_with_memory(&swm, &inspect, (4 * STACK + (STACK >> 1)) >> 10, &STACK.to_string());
    assert!(output.status.success(), "{}", text(&output.stderr));
}

/// MuJoCo goes on with a null pointer, or ends the process, where an allocation of its own fails.
#[cfg(target_os = "linux")]
#[test]
fn environment_of_mujoco_without_memory_ends_with_an_error() {
    let swm = Swm::new();
    for (env, most) in [("swm/HumanoidDMControl-v0", 400), ("swm/OGBCube-v0", 900)] {
        let frame = ["frame", env, "-o", "frame.png", "--renderer", "cpu", "--threads", "1"];
        for megabytes in (100..most).step_by(50).chain([4000]) {
            let output = run_with_memory(&swm, &frame, megabytes << 10, "");
            let (code, error) = (output.status.code(), text(&output.stderr));
            assert!(matches!(code, Some(0 | 1)), "{env}, {megabytes} MB: {:?}: {error}", output.status);
            assert!(code == Some(0) || error.contains("out of memory"), "{env}, {megabytes} MB: {error}");
            assert!(code == Some(0) || megabytes < 4000, "{env} needs less: {error}");
        }
    }
}

/// A running command that gets signals. It is killed after five minutes, so that a test ends.
#[cfg(target_os = "linux")]
struct Running {
    child: std::process::Child,
    lines: std::io::Lines<std::io::BufReader<std::process::ChildStderr>>,
    /// Dropped at the end, so that the program is not killed.
    _ended: std::sync::mpsc::Sender<()>,
}

#[cfg(target_os = "linux")]
impl Running {
    fn start(swm: &Swm, args: &[&str]) -> Self {
        use std::io::BufRead as _;
        let mut child = swm.command(args).stderr(std::process::Stdio::piped()).spawn().expect("swm starts");
        let lines = std::io::BufReader::new(child.stderr.take().expect("standard error")).lines();
        let (_ended, timeout) = std::sync::mpsc::channel::<()>();
        let id = child.id().to_string();
        std::thread::spawn(move || {
            if timeout.recv_timeout(std::time::Duration::from_secs(300)) == Err(RecvTimeoutError::Timeout) {
                let _sent = Command::new("kill").args(["-KILL", &id]).status();
            }
        });
        Self { child, lines, _ended }
    }

    /// Whether the mask of signals has this number.
    fn has(&self, mask: &str, signal: u32) -> bool {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("a process");
        let mask = status.lines().find_map(|line| line.strip_prefix(mask)).expect("a mask of signals");
        u64::from_str_radix(mask.trim(), 16).expect("a number") >> (signal - 1) & 1 == 1
    }

    /// Waits until the program handles interrupts.
    fn wait_for_handler(&self) {
        let handles_interrupts = || {
            // Shells start jobs in the background of scripts so, and the program leaves it.
            assert!(!self.has("SigIgn:", 2), "the tests run where SIGINT is ignored");
            self.has("SigCgt:", 2)
        };
        while !handles_interrupts() {
            std::thread::yield_now();
        }
    }

    /// Waits for a line of standard error.
    fn wait_for(&mut self, text: &str) {
        let mut said = vec![];
        for line in self.lines.by_ref().map_while(Result::ok) {
            if line.contains(text) {
                return;
            }
            said.push(line);
        }
        panic!("the program ended without '{text}' ({:?}): {}", self.child.wait(), said.join("\n"));
    }

    /// The processor time of the program, in ticks of a hundredth of a second.
    fn ticks(&self) -> u64 {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id())).expect("a process");
        // The name of the program, in parentheses, is the second field.
        let fields = stat.rsplit(") ").next().expect("fields after the name");
        fields.split(' ').nth(11).and_then(|field| field.parse().ok()).expect("the time in user mode")
    }

    /// Waits until the program has worked for a second more.
    fn wait_for_work(&self) {
        let start = self.ticks();
        while self.ticks() < start + 100 {
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
    }

    fn signal(&self, name: &str) {
        let sent = Command::new("kill").args([&format!("-{name}"), &self.child.id().to_string()]).status();
        assert!(sent.expect("kill starts").success());
    }

    /// Waits for the end; returns the exit code.
    fn end(mut self) -> Option<i32> {
        self.child.wait().expect("the program ends").code()
    }
}

#[cfg(target_os = "linux")]
#[test]
fn first_signal_stops_a_benchmark() {
    let swm = Swm::new();
    let long = ["--pairs", "1", "--seconds", "3600"];
    for bench in [&["envs", "swm/TwoRoom-v1", "--sizes", "32"][..], &["plan", "--envs", "1", "--iterations", "0"]] {
        let running = Running::start(&swm, &[&["bench"], bench, &long].concat());
        running.wait_for_handler();
        running.signal("INT");
        assert_eq!(running.end(), Some(130), "{bench:?}");
    }
}

/// The unit of work is one plan of many iterations, during which nothing looks at the first signal.
#[cfg(target_os = "linux")]
#[test]
fn second_signal_ends_the_program() {
    let swm = Swm::new();
    let solver = ["--solver", "cem,samples=100000,iterations=100000", "--budget", "3"];
    for (signal, code) in [("INT", 130_u32), ("TERM", 143), ("HUP", 129)] {
        let args = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--image", "32", "--episodes", "1"];
        let mut running = Running::start(&swm, &[&args[..], &solver].concat());
        running.wait_for("evaluate: random");
        if running.has("SigIgn:", code - 128) {
            // The tests run so, under nohup or in the background of a script, and the program leaves it.
            running.signal("KILL");
            continue;
        }
        // The plan has begun then, whatever the load of the machine.
        running.wait_for_work();
        running.signal(signal);
        running.wait_for("stopping at the next safe point");
        running.signal(signal);
        assert_eq!(running.end(), i32::try_from(code).ok(), "{signal}");
    }
}
