//! [`Patience`]: time-outs of a remote store, and a message when the store does not answer.

use async_trait::async_trait;
use bytes::Bytes;
use futures::stream::{BoxStream, StreamExt as _};
use object_store::path::Path;
use object_store::{
    ClientConfigKey, CopyOptions, GetOptions, GetResultPayload, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    PutMultipartOptions, PutOptions, PutPayload, PutResult, RetryConfig, UploadPart,
};
use object_store::{GetResult, Result};
use std::fmt;
use std::future::Future;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

/// The time without an answer after which a message is logged.
const QUIET: Duration = Duration::from_secs(3);
/// The time between two messages.
const BETWEEN_MESSAGES: Duration = Duration::from_secs(10);
/// The time to connect.
pub(super) const CONNECT: Duration = Duration::from_secs(5);
/// The time without a byte of an answer; a request's body is sent within it.
pub(super) const READ: Duration = Duration::from_secs(20);
/// The time of a whole request.
pub(super) const TOTAL: Duration = Duration::from_secs(300);
/// The time after which a failed request is not repeated.
const RETRY: Duration = Duration::from_secs(30);

/// The settings of a client: the time-outs of a request. Other settings come from environment variables.
pub(super) fn client_settings() -> [(ClientConfigKey, String); 4] {
    let seconds = |time: Duration| format!("{}s", time.as_secs());
    [
        (ClientConfigKey::ConnectTimeout, seconds(CONNECT)),
        (ClientConfigKey::ReadTimeout, seconds(READ)),
        (ClientConfigKey::Timeout, seconds(TOTAL)),
        (ClientConfigKey::AllowHttp, "true".to_owned()),
    ]
}

/// The repetitions of a failed request, with pauses of about six seconds in total.
pub(super) fn retry_config() -> RetryConfig {
    RetryConfig { max_retries: 6, retry_timeout: RETRY, ..RetryConfig::default() }
}

/// A remote store that logs a message when a request has no answer for three seconds.
#[derive(Debug)]
pub(super) struct Patience<T> {
    pub inner: Arc<T>,
    /// The server in messages.
    pub name: String,
}

impl<T> fmt::Display for Patience<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

/// Waits for an answer, and reports when there is none.
async fn answer<R>(name: &str, request: impl Future<Output = R>) -> R {
    answer_or_report(name, READ, request).await
}

/// Waits for an answer that is given up after `limit`, and reports when there is none.
pub(crate) async fn answer_or_report<R>(name: &str, limit: Duration, request: impl Future<Output = R>) -> R {
    answer_within(QUIET, request, |waited| report(name, limit, waited)).await
}

/// Waits for an answer, and calls `on_quiet` when there is none within `quiet`, and every ten seconds after that.
async fn answer_within<R>(quiet: Duration, request: impl Future<Output = R>, mut on_quiet: impl FnMut(Duration)) -> R {
    let mut request = std::pin::pin!(request);
    let start = Instant::now();
    let mut next = quiet;
    loop {
        match tokio::time::timeout(next, &mut request).await {
            Ok(answer) => return answer,
            Err(_) => on_quiet(start.elapsed()),
        }
        next = BETWEEN_MESSAGES;
    }
}

/// Logs that a server does not answer, unless a message was logged shortly before.
fn report(name: &str, limit: Duration, waited: Duration) {
    static START: LazyLock<Instant> = LazyLock::new(Instant::now);
    /// The time of the next message, in milliseconds after `START`.
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let now = START.elapsed().as_millis() as u64;
    let next = NEXT.load(Ordering::Relaxed);
    let later = now + BETWEEN_MESSAGES.as_millis() as u64;
    if now >= next && NEXT.compare_exchange(next, later, Ordering::Relaxed, Ordering::Relaxed).is_ok() {
        tracing::warn!(
            "{name} has not answered for {} s; a request is given up after {} s",
            waited.as_secs(),
            limit.as_secs()
        );
    }
}

#[async_trait]
impl<T: ObjectStore> ObjectStore for Patience<T> {
    async fn put_opts(&self, location: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        answer(&self.name, self.inner.put_opts(location, payload, options)).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        let inner = answer(&self.name, self.inner.put_multipart_opts(location, options)).await?;
        Ok(Box::new(PatientUpload { inner, name: self.name.clone() }))
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        let result = answer(&self.name, self.inner.get_opts(location, options)).await?;
        let payload = match result.payload {
            GetResultPayload::Stream(body) => GetResultPayload::Stream(patient_stream(self.name.clone(), body)),
            file @ GetResultPayload::File(..) => file,
        };
        Ok(GetResult { payload, ..result })
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        answer(&self.name, self.inner.get_ranges(location, ranges)).await
    }

    fn delete_stream(&self, locations: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        patient_stream(self.name.clone(), self.inner.list(prefix))
    }

    fn list_with_offset(&self, prefix: Option<&Path>, offset: &Path) -> BoxStream<'static, Result<ObjectMeta>> {
        patient_stream(self.name.clone(), self.inner.list_with_offset(prefix, offset))
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        answer(&self.name, self.inner.list_with_delimiter(prefix)).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        answer(&self.name, self.inner.copy_opts(from, to, options)).await
    }
}

fn patient_stream<R: Send + 'static>(name: String, items: BoxStream<'static, R>) -> BoxStream<'static, R> {
    futures::stream::unfold((name, items), |(name, mut items)| async move {
        let item = answer(&name, items.next()).await?;
        Some((item, (name, items)))
    })
    .boxed()
}

/// An upload in parts to a [`Patience`].
#[derive(Debug)]
struct PatientUpload {
    inner: Box<dyn MultipartUpload>,
    name: String,
}

#[async_trait]
impl MultipartUpload for PatientUpload {
    fn put_part(&mut self, data: PutPayload) -> UploadPart {
        let (part, name) = (self.inner.put_part(data), self.name.clone());
        Box::pin(async move { answer(&name, part).await })
    }

    async fn complete(&mut self) -> Result<PutResult> {
        answer(&self.name, self.inner.complete()).await
    }

    async fn abort(&mut self) -> Result<()> {
        answer(&self.name, self.inner.abort()).await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_answer_is_reported() {
        let quiet = Duration::from_millis(1);
        let (sender, receiver) = tokio::sync::oneshot::channel();
        let mut sender = Some(sender);
        let report = |waited| {
            assert!(waited >= quiet);
            sender.take().expect("one report").send(7).expect("sending the answer");
        };
        let waiting = async { answer_within(quiet, receiver, report).await };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        assert_eq!(runtime.block_on(waiting), Ok(7));
        let prompt = answer_within(Duration::MAX, async { 8 }, |_| panic!("an answer without delay"));
        assert_eq!(runtime.block_on(prompt), 8);
    }
}
