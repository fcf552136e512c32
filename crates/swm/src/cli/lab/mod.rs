//! `swm lab`: the local web application (docs/lab.md).

mod bench;
mod planning;
mod program;
mod reports;
mod wrapping;

use super::{Context, emit, emit_json, eprint};
use crate::resolver::scripted;
use crate::{ENVS, home};
use clap::Args;
use planning::HomePlanning;
use program::OwnProgram;
pub use reports::Pages;
use serde_json::json;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use swm_core::{Error, Result};
use swm_data::hub::HubUri;
use swm_data::{FORMATS, Location, open};
use swm_lab::folders::Folders;
use swm_lab::sources::Source;
use swm_lab::{Lab, Options, Token, serve};
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
    /// Another folder of datasets, a dataset, or a URI; may be repeated
    ///
    /// A URI names a dataset, as for `swm inspect`, or a prefix of s3://, gs:// or az:// below which datasets lie. Datasets of the hub
    /// (hf://) are downloaded before the lab starts.
    #[arg(long, value_name = "DIR|URI")]
    data: Vec<String>,
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
    let (datasets, sources) = datasets(&args.data)?;
    let lab = Lab {
        envs: &ENVS,
        wrapping: Box::new(OwnWrappers),
        policy: scripted,
        planning: Box::new(HomePlanning::new(runs.clone())),
        reports: Box::new(Pages),
        results: folders(home::home()?, &args.results)?,
        program: Box::new(OwnProgram),
        datasets,
        sources,
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
        browse(&url);
    }
    server.run(&context.interrupt);
    Ok(())
}

/// The folders of datasets, and what `--data` names beside.
fn datasets(given: &[String]) -> Result<(Folders, Vec<Source>)> {
    let (mut folders, mut sources) = (vec![home::datasets()?], vec![]);
    for given in given {
        let location =
            if given.contains("://") { home::location(given)? } else { Location::from(PathBuf::from(given)) };
        let is_named = FORMATS.rows.iter().any(|format| format.has_suffix(&location));
        match location.path() {
            None => sources.push(Source::at(location)?),
            // A download has the name of its commit, so that its format is detected.
            Some(path) if path.exists() && (is_named || HubUri::is_uri(given) && open(&location).is_ok()) => {
                let name = given.trim_end_matches('/').rsplit('/').next().unwrap_or(given);
                sources.push(Source::dataset(location.clone(), name));
            }
            Some(path) if path.is_dir() => folders.push(path.to_owned()),
            Some(_) => {
                let fix = "give an existing folder of datasets, a dataset, or the URI of one";
                return Err(Error::config(given, "is neither a folder nor a dataset", fix));
            }
        }
    }
    Ok((Folders::new(folders), sources))
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
fn browse(url: &str) {
    let program = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let mut command = Command::new(program);
    command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    if command.spawn().is_err() {
        eprint(&format!("{program} is not installed: open the URL in a browser\n"));
    }
}
