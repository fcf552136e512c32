//! [`Connector`]: the HTTP client of a store that gets credentials. Signatures, and the tokens of sessions beside them, stay with the host
//! that they are for.

use super::patience::{CONNECT, READ, TOTAL};
use object_store::client::{HttpClient, HttpConnector};
use object_store::{ClientConfigKey, ClientOptions, Result};
use reqwest::redirect::{Attempt, Policy};
use std::time::Duration;

/// The most redirections within a host.
const MAX_REDIRECTIONS: usize = 10;

/// Makes clients that follow redirections within a host only, and that tell no server where a request came from: an address can
/// have a signature. reqwest removes no more than `Authorization` and cookies.
#[derive(Debug)]
pub(super) struct Connector;

impl HttpConnector for Connector {
    fn connect(&self, options: &ClientOptions) -> Result<HttpClient> {
        let is_set = |key| options.get_config_value(&key).is_some_and(|value| value == "true");
        let mut builder = reqwest::Client::builder()
            .user_agent(concat!("stable-worldmodel/", env!("CARGO_PKG_VERSION")))
            .redirect(Policy::custom(redirected))
            .referer(false)
            .https_only(!is_set(ClientConfigKey::AllowHttp))
            .tls_danger_accept_invalid_certs(is_set(ClientConfigKey::AllowInvalidCertificates));
        if is_set(ClientConfigKey::Http1Only) {
            builder = builder.http1_only();
        }
        if let Some(address) = options.get_config_value(&ClientConfigKey::ProxyUrl) {
            let excluded = options.get_config_value(&ClientConfigKey::ProxyExcludes);
            let excluded = excluded.and_then(|names| reqwest::NoProxy::from_string(&names));
            builder = builder.proxy(reqwest::Proxy::all(address).map_err(invalid)?.no_proxy(excluded));
        }
        if let Some(certificate) = options.get_config_value(&ClientConfigKey::ProxyCaCertificate) {
            let certificate = reqwest::Certificate::from_pem(certificate.as_bytes()).map_err(invalid)?;
            builder = builder.tls_certs_merge([certificate]);
        }
        if let Some(name) = options.get_config_value(&ClientConfigKey::UserAgent) {
            builder = builder.user_agent(name);
        }
        // Requests for credentials have shorter times than others.
        let time = |key, usual| options.get_config_value(&key).and_then(|text| seconds(&text)).unwrap_or(usual);
        builder = builder
            .connect_timeout(time(ClientConfigKey::ConnectTimeout, CONNECT))
            .read_timeout(time(ClientConfigKey::ReadTimeout, READ))
            .timeout(time(ClientConfigKey::Timeout, TOTAL));
        Ok(HttpClient::new(builder.build().map_err(invalid)?))
    }
}

/// Reads a duration as object_store writes it: `1s`, `5m`, `1m 30s`, `500ms`.
fn seconds(text: &str) -> Option<Duration> {
    let part = |part: &str| {
        let digits = part.find(|c: char| !c.is_ascii_digit())?;
        let (count, unit) = (part[..digits].parse::<u64>().ok()?, &part[digits..]);
        match unit {
            "ms" => Some(Duration::from_millis(count)),
            "s" => Some(Duration::from_secs(count)),
            "m" => Some(Duration::from_secs(count.saturating_mul(60))),
            "h" => Some(Duration::from_secs(count.saturating_mul(3600))),
            _ => None,
        }
    };
    text.split_whitespace().try_fold(Duration::ZERO, |sum, text| Some(sum.saturating_add(part(text)?)))
}

fn invalid(error: reqwest::Error) -> object_store::Error {
    object_store::Error::Generic { store: "http", source: Box::new(error) }
}

/// Follows a redirection that stays at the host of the first request; from HTTP to HTTPS as well.
fn redirected(attempt: Attempt<'_>) -> reqwest::redirect::Action {
    let (next, first) = (attempt.url(), attempt.previous().first());
    let stays = first.is_some_and(|first| {
        let is_upgrade = first.scheme() == "http" && next.scheme() == "https" && first.host() == next.host();
        first.origin() == next.origin() || is_upgrade
    });
    if stays && attempt.previous().len() <= MAX_REDIRECTIONS { attempt.follow() } else { attempt.stop() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_read_as_they_are_written() {
        for (text, expected) in [("1s", 1000), ("5m", 300_000), ("1m 30s", 90_000), ("500ms", 500), ("2h", 7_200_000)] {
            assert_eq!(seconds(text), Some(Duration::from_millis(expected)), "{text}");
        }
        assert_eq!([seconds("soon"), seconds("5"), seconds("1s x")], [None; 3]);
    }
}
