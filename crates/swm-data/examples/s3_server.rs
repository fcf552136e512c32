//! An S3 server on loopback for benchmarks. It serves the subfolders of a folder as buckets:
//!
//! ```sh
//! mkdir -p /tmp/buckets/bench && cargo run --release --workspace --example s3_server -- /tmp/buckets &
//! export AWS_ENDPOINT_URL=http://127.0.0.1:9753 AWS_REGION=us-east-1 AWS_SKIP_SIGNATURE=true
//! swm bench data --formats lance --load-only --remote s3://bench/data
//! ```

#![allow(clippy::print_stdout, reason = "the server prints its address")]

use hyper_util::rt::{TokioExecutor, TokioIo};
use s3s::service::S3ServiceBuilder;
use std::error::Error;

/// The address that the server listens on.
const ADDRESS: &str = "127.0.0.1:9753";

fn main() -> Result<(), Box<dyn Error>> {
    let root = std::env::args().nth(1).ok_or("name the folder that holds the buckets")?;
    let files = s3s_fs::FileSystem::new(&root).map_err(|error| format!("{root}: {error:?}"))?;
    let service = S3ServiceBuilder::new(files).build();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async move {
        let listener = tokio::net::TcpListener::bind(ADDRESS).await?;
        println!("serving the folders of {root} at http://{ADDRESS}");
        loop {
            let (socket, _) = listener.accept().await?;
            let service = service.clone();
            tokio::spawn(async move {
                // A failed connection does not affect other clients.
                let server = hyper_util::server::conn::auto::Builder::new(TokioExecutor::new());
                let _ = server.serve_connection(TokioIo::new(socket), service).await;
            });
        }
    })
}
