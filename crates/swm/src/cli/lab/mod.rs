//! `swm lab`: the local web application (docs/lab.md).

mod bench;
mod planning;
mod reports;
mod training;
mod wrapping;

use super::{Context, emit, emit_json, eprint};
use crate::resolver::scripted;
use crate::{ENVS, home};
use clap::Args;
use planning::HomePlanning;
use reports::Pages;
use serde_json::json;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use swm_core::{Error, Result};
use swm_lab::folders::Folders;
use swm_lab::{Lab, Options, Token, serve};
use training::OwnProgram;
use wrapping::OwnWrappers;

pub use bench::{LabBenchArgs, bench};

/// Arguments of `swm lab`.
#[derive(Args)]
pub struct LabArgs {
    /// Print the URL, and open no browser
    #[arg(long)]
    no_open: bool,
    /// Port; 0 for any free one
    #[arg(long, default_value_t = 0)]
    port: u16,
    /// Address to listen on; another than 127.0.0.1 needs --token
    #[arg(long, value_name = "ADDRESS", default_value_t = IpAddr::V4(Ipv4Addr::LOCALHOST))]
    listen: IpAddr,
    /// Token of the URL, at least 16 characters (default: random)
    ///
    /// It permits to use the lab. SWM_LAB_TOKEN can hold it instead, which keeps it out of the list of processes.
    #[arg(long)]
    token: Option<String>,
    /// Another folder of datasets; may be repeated
    #[arg(long, value_name = "DIR")]
    data: Vec<PathBuf>,
    /// Another folder of training runs; may be repeated
    #[arg(long, value_name = "DIR")]
    runs: Vec<PathBuf>,
    /// Another folder of results and studies; may be repeated
    #[arg(long, value_name = "DIR")]
    results: Vec<PathBuf>,
}

/// Runs `swm lab` until Ctrl-C.
pub fn lab(args: &LabArgs, context: &Context) -> anyhow::Result<()> {
    let options = Options { address: args.listen, port: args.port, token: token(args)? };
    let folders = |first: PathBuf, others: &[PathBuf]| -> Result<Folders> {
        if let Some(missing) = others.iter().find(|folder| !folder.is_dir()) {
            return Err(Error::config(missing.display().to_string(), "is not a folder", "give an existing folder"));
        }
        Ok(Folders::new(std::iter::once(first).chain(others.iter().cloned()).collect()))
    };
    let runs = folders(home::checkpoints()?, &args.runs)?;
    let lab = Lab {
        envs: &ENVS,
        wrapping: Box::new(OwnWrappers),
        policy: scripted,
        planning: Box::new(HomePlanning::new(runs.clone())),
        reports: Box::new(Pages),
        results: folders(home::home()?, &args.results)?,
        training: Box::new(OwnProgram { threads: context.threads }),
        datasets: folders(home::datasets()?, &args.data)?,
        runs,
        threads: context.threads,
        measured: None,
    };
    let server = serve(lab, &options)?;
    let url = server.url();
    if context.json {
        emit_json(&json!({"url": url}))?;
    } else {
        emit(&format!("{url}\n"));
        eprint("Ctrl-C ends the lab\n");
    }
    if !args.no_open {
        open(&url);
    }
    server.run(&context.interrupt);
    Ok(())
}

/// The token of the command line, or a random one.
fn token(args: &LabArgs) -> Result<Token> {
    let given = args.token.clone().or_else(|| std::env::var("SWM_LAB_TOKEN").ok().filter(|text| !text.is_empty()));
    match given {
        Some(text) => Token::parse(&text),
        None if args.listen.is_loopback() => Ok(Token::random()),
        None => {
            let problem = "other machines can reach this address, and the lab writes datasets";
            let fix = "choose a token with --token, or use an SSH tunnel to 127.0.0.1";
            Err(Error::config(format!("--listen {}", args.listen), problem, fix))
        }
    }
}

/// Opens a URL in the browser. If that fails, the URL that was printed remains.
fn open(url: &str) {
    let program = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let mut command = Command::new(program);
    command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    if command.spawn().is_err() {
        eprint(&format!("{program} is not installed: open the URL in a browser\n"));
    }
}
