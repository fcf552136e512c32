//! `swm bench lab`: frames and latency of the lab, measured by its page in a browser.

use super::planning::HomePlanning;
use super::program::OwnProgram;
use super::reports::Pages;
use super::wrapping::OwnWrappers;
use crate::ENVS;
use crate::cli::config::{count, seconds};
use crate::cli::{Context, emit, emit_json, table};
use crate::resolver::scripted;
use clap::Args;
use serde_json::Value;
use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};
use swm_core::limits::IMAGE_SIDE;
use swm_core::{Error, Origin, Result};
use swm_lab::folders::Folders;
use swm_lab::{Lab, Options, Token, serve};

/// The time that a browser has to start and to measure beside the seconds of frames.
const PATIENCE: Duration = Duration::from_secs(60);
/// How often it is looked whether the user interrupts.
const POLL: Duration = Duration::from_millis(100);

/// Arguments of `swm bench lab`.
#[derive(Args)]
pub struct LabBenchArgs {
    /// Ids of environments
    #[arg(default_value = "swm/PushT-v1")]
    envs: Vec<String>,
    /// Side of frames, in pixels
    #[arg(long, default_value_t = 224, value_parser = count::<1, { IMAGE_SIDE.max }>)]
    image: usize,
    /// Seconds of frames
    #[arg(long, default_value = "5", value_parser = seconds)]
    seconds: f64,
    /// The browser, a Chromium (default: $SWM_CHROMIUM, or chromium)
    #[arg(long, value_name = "PROGRAM")]
    browser: Option<String>,
}

/// Runs `swm bench lab`.
pub fn bench(args: &LabBenchArgs, context: &Context) -> anyhow::Result<()> {
    for id in &args.envs {
        crate::env(id, &Origin::User)?;
    }
    let home = tempfile::tempdir()?;
    let (sender, measured) = channel();
    let runs = Folders::default();
    let lab = Lab {
        envs: &ENVS,
        wrapping: Box::new(OwnWrappers),
        policy: scripted,
        planning: Box::new(HomePlanning::new(runs.clone())),
        reports: Box::new(Pages),
        results: Folders::default(),
        program: Box::new(OwnProgram),
        datasets: Folders::default(),
        sources: vec![],
        runs,
        threads: context.threads,
        measured: Some(sender),
    };
    let server = serve(lab, &Options { address: IpAddr::V4(Ipv4Addr::LOCALHOST), port: 0, token: Token::random() })?;
    let (url, stop) = (server.url(), Arc::new(AtomicBool::new(false)));
    let until = Arc::clone(&stop);
    let running = std::thread::spawn(move || server.run(&until));
    let found: Result<Vec<Value>> =
        args.envs.iter().map(|id| measure(args, id, &url, home.path(), &measured, context)).collect();
    stop.store(true, Ordering::Relaxed);
    running.join().map_err(|panic| Error::panicked("the lab panicked", &*panic))?;
    let found = found?;
    if context.json {
        return emit_json(&found);
    }
    let row = |one: &Value| {
        let number = |name: &str| one[name].as_f64().unwrap_or_default();
        let name = one["env"].as_str().unwrap_or_default().to_owned();
        let rates = ["sent", "presented"].map(|name| format!("{:.1}", number(name)));
        let times = ["latency", "load"].map(|name| format!("{:.0} ms", number(name)));
        [vec![name], rates.to_vec(), times.to_vec()].concat()
    };
    let head = ["environment", "frames/s sent", "frames/s presented", "input to pixel", "page loaded in"];
    emit(&table(&head, found.iter().map(row)));
    Ok(())
}

/// Measures an environment in a browser of its own.
fn measure(
    args: &LabBenchArgs,
    id: &str,
    url: &str,
    home: &Path,
    measured: &Receiver<Value>,
    context: &Context,
) -> Result<Value> {
    let page = format!("{url}#bench?env={id}&image={}&seconds={}", args.image, args.seconds);
    let mut browser = browser(args, &page, home)?;
    let until = Instant::now() + PATIENCE + Duration::from_secs_f64(args.seconds);
    let found = loop {
        match measured.recv_timeout(POLL) {
            Ok(found) => break Ok(found),
            Err(RecvTimeoutError::Timeout) if context.interrupt.load(Ordering::Relaxed) => {
                break Err(Error::Interrupted);
            }
            Err(RecvTimeoutError::Timeout) if Instant::now() < until => {}
            Err(_) => {
                let fix = "choose another --browser, or fewer --seconds";
                break Err(Error::config("the benchmark of the lab", "the browser measured nothing", fix));
            }
        }
    };
    browser.kill().and_then(|()| browser.wait()).ok();
    let found = found?;
    match found["error"].as_str() {
        Some(problem) => Err(Error::external(format!("measuring {id} in the browser"), problem)),
        None => Ok(found),
    }
}

/// Opens a page in a browser without a window, whose files are in `home`.
fn browser(args: &LabBenchArgs, page: &str, home: &Path) -> Result<Child> {
    let chosen = std::env::var("SWM_CHROMIUM").ok().filter(|program| !program.is_empty());
    let program = args.browser.clone().or(chosen).unwrap_or_else(|| "chromium".to_owned());
    let mut command = Command::new(&program);
    command.args(["--headless=new", "--no-first-run", "--window-size=1280,800", "--disable-background-networking"]);
    command.arg(format!("--user-data-dir={}", home.join("browser").display()));
    // Chromium has no sandbox for root.
    if is_root() {
        command.arg("--no-sandbox");
    }
    command.arg(page).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().map_err(|error| {
        let fix = "install Chromium, or name it with --browser";
        Error::config(format!("the browser {program}"), error.to_string(), fix)
    })
}

#[allow(unsafe_code, reason = "the id of the user is a function of the C library")]
fn is_root() -> bool {
    // SAFETY: it reads no memory.
    unsafe { libc::geteuid() == 0 }
}
