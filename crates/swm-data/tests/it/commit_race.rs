//! Two commits of the same shards at once.

use crate::sample::{episode, options, schema};
use async_trait::async_trait;
use futures::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore, PutMultipartOptions,
    PutOptions, PutPayload, PutResult, Result,
};
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use swm_data::lance::{Shard, commit_shards, create_shard};
use swm_data::objects::provide;
use swm_data::{Location, WriteMode};

/// A store that has the objects `before` another process committed, and those `after` it from the read with the number
/// `at` on.
#[derive(Debug)]
struct Overtaken {
    before: InMemory,
    after: InMemory,
    at: usize,
    reads: AtomicUsize,
}

impl Overtaken {
    fn now(&self) -> &InMemory {
        if self.reads.load(Ordering::Relaxed) > self.at { &self.after } else { &self.before }
    }
}

impl fmt::Display for Overtaken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("overtaken")
    }
}

#[async_trait]
impl ObjectStore for Overtaken {
    async fn put_opts(&self, location: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        self.now().put_opts(location, payload, options).await
    }

    async fn put_multipart_opts(&self, at: &Path, options: PutMultipartOptions) -> Result<Box<dyn MultipartUpload>> {
        self.now().put_multipart_opts(at, options).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.reads.fetch_add(1, Ordering::Relaxed);
        self.now().get_opts(location, options).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        self.now().delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.now().list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.now().list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.now().copy_opts(from, to, options).await
    }
}

fn location(name: &str) -> Location {
    Location::Uri(url::Url::parse(&format!("store://{name}/data.lance")).expect("a URI"))
}

#[test]
fn commit_that_another_overtakes_does_not_report_damage() {
    let store = Arc::new(InMemory::new());
    provide("overtaking", Arc::clone(&store) as Arc<dyn ObjectStore>);
    for index in 0..2 {
        let shard = Shard { index, count: 2 };
        let at = location("overtaking");
        let mut writer = create_shard(&at, &schema(), options(WriteMode::Create), shard).expect("creating the shard");
        writer.write_episode(&episode(index)).expect("writing an episode");
        writer.finish().expect("finishing the shard");
    }
    let before = store.fork();
    assert_eq!(commit_shards(&location("overtaking")).expect("committing the shards"), 2);
    let mut overtaken = 0;
    for at in 0..12 {
        let name = format!("overtaken-{at}");
        let reads = AtomicUsize::new(0);
        provide(&name, Arc::new(Overtaken { before: before.fork(), after: store.fork(), at, reads }));
        // A commit of shards that are committed adds nothing, and one that ends before the other adds all.
        let Err(error) = commit_shards(&location(&name)) else { continue };
        let words = ["another process committed its shards meanwhile", "has no shards to commit"];
        assert!(words.iter().any(|words| error.to_string().contains(words)), "{at}: {error}");
        overtaken += 1;
    }
    assert!(overtaken > 0);
}
