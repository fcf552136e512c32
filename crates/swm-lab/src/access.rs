//! Who may use the lab: requests to this machine, from this machine's pages, that carry the token.
//!
//! The token is the first part of every path, so pages need no cookies, which browsers share between ports. `Host` is
//! compared with the addresses of the server, because a name that a stranger's DNS server points to the loopback address
//! would otherwise make their page one of the same origin (DNS rebinding). `Origin` is compared with `Host`, because browsers
//! permit WebSockets to any origin.

use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use rand::RngCore as _;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use swm_core::{Error, Result};

/// The shortest token that a user may choose, in characters.
const SHORTEST: usize = 16;
/// The longest token, in characters.
const LONGEST: usize = 128;
/// The time between two lines about refused requests.
const QUIET: Duration = Duration::from_secs(1);

/// The secret part of the lab's address.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// A random token of 128 bits.
    pub fn random() -> Self {
        let mut bytes = [0_u8; 16];
        rand::rng().fill_bytes(&mut bytes);
        Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// A token that the user chose.
    ///
    /// # Errors
    /// When it is shorter than 16 characters, longer than 128, or has other characters than letters, digits, `-` and `_`.
    pub fn parse(text: &str) -> Result<Self> {
        let valid = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if !(SHORTEST..=LONGEST).contains(&text.len()) || !text.chars().all(valid) {
            let problem = format!("it has {} characters, or other ones than letters, digits, - and _", text.len());
            return Err(Error::config(
                "--token",
                problem,
                format!("choose {SHORTEST} to {LONGEST} of these characters at random"),
            ));
        }
        Ok(Self(text.to_owned()))
    }

    /// The text of the token.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Whether a text is the token. The time does not depend on where they differ: hashes are compared.
    fn is(&self, given: &str) -> bool {
        blake3::hash(given.as_bytes()) == blake3::hash(self.0.as_bytes())
    }
}

/// The checks of every request.
#[derive(Clone)]
pub struct Access {
    /// The token.
    pub token: Token,
    /// Whether the server listens on a loopback address only.
    pub is_local: bool,
    /// The refused requests, for the log.
    pub refusals: Arc<Refusals>,
}

/// Counts refused requests, so that a flood of them writes one line a second.
#[derive(Default)]
pub struct Refusals(Mutex<Logged>);

#[derive(Default)]
struct Logged {
    /// When the last line was written.
    at: Option<Instant>,
    /// How many requests had no line since.
    left_out: usize,
}

impl Refusals {
    /// Counts a request. Returns how many had no line before, if this one gets a line.
    pub fn count(&self, now: Instant) -> Option<usize> {
        let mut logged = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if logged.at.is_some_and(|at| now.saturating_duration_since(at) < QUIET) {
            logged.left_out += 1;
            return None;
        }
        logged.at = Some(now);
        Some(std::mem::take(&mut logged.left_out))
    }
}

/// Why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// `Host` is no address of this server.
    Host,
    /// `Origin` or `Sec-Fetch-Site` names another page.
    Origin,
    /// The path does not begin with the token.
    Token,
}

impl Refusal {
    /// The status of the answer.
    pub fn status(self) -> StatusCode {
        match self {
            Self::Host => StatusCode::MISDIRECTED_REQUEST,
            Self::Origin | Self::Token => StatusCode::FORBIDDEN,
        }
    }

    /// The text of the answer.
    pub fn message(self) -> &'static str {
        match self {
            Self::Host => "the Host of this request is no address of the lab; open the URL that `swm lab` printed\n",
            Self::Origin => "a page of another origin sent this request; open the URL that `swm lab` printed\n",
            Self::Token => "this URL lacks the token of the lab; open the URL that `swm lab` printed\n",
        }
    }
}

impl Access {
    /// Checks a request, and returns its URI without the token.
    ///
    /// # Errors
    /// The reason to refuse the request.
    pub fn check(&self, uri: &Uri, headers: &HeaderMap) -> std::result::Result<Uri, Refusal> {
        let host = one(headers, header::HOST).filter(|host| self.is_own(host)).ok_or(Refusal::Host)?;
        let is_foreign_site = headers
            .get_all("sec-fetch-site")
            .iter()
            .any(|site| !["same-origin", "none"].map(str::as_bytes).contains(&site.as_bytes()));
        let origins = headers.get_all(header::ORIGIN);
        let own = format!("http://{host}");
        if is_foreign_site || origins.iter().any(|origin| origin.as_bytes() != own.as_bytes()) {
            return Err(Refusal::Origin);
        }
        let path = uri.path().strip_prefix('/').ok_or(Refusal::Token)?;
        let (token, rest) = path.split_once('/').ok_or(Refusal::Token)?;
        if uri.authority().is_some() || !self.token.is(token) {
            return Err(Refusal::Token);
        }
        let query = uri.query().map_or(String::new(), |query| format!("?{query}"));
        format!("/{rest}{query}").parse().map_err(|_| Refusal::Token)
    }

    /// Whether a host, with or without a port, is an address of this server: no name of a stranger resolves to an address
    /// that is written as such. Any port is permitted, because an SSH tunnel has its own.
    fn is_own(&self, host: &str) -> bool {
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.parse::<u16>().is_ok() => name,
            _ => host,
        };
        if name == "localhost" {
            return true;
        }
        let address = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
        let address: Option<IpAddr> = address.parse().ok();
        address.is_some_and(|address| !self.is_local || address.is_loopback())
    }
}

/// The only value of a header; `None` if there are none or several.
fn one(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    let mut values = headers.get_all(name).iter();
    let value: &HeaderValue = values.next()?;
    if values.next().is_some() { None } else { value.to_str().ok() }
}

/// The policy of a report in a frame of the lab: no script, no connection, and an origin of its own, so that it cannot reach
/// the lab. Links open other pages.
pub const REPORT: &str = "sandbox allow-popups allow-popups-to-escape-sandbox; default-src 'none'; \
                          style-src 'unsafe-inline'; img-src data:; media-src data:; font-src data:; base-uri 'none'; \
                          form-action 'none'; frame-ancestors 'self'";

/// Adds the headers that bind a page to this server: no script, style, image or connection of another origin, no frame around
/// the page, no address in a `Referer`. A report keeps its own policy.
pub fn add_headers(headers: &mut HeaderMap) {
    const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; \
                          connect-src 'self'; font-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; \
                          frame-ancestors 'none'";
    let is_report = headers.contains_key(header::CONTENT_SECURITY_POLICY);
    let policies = [(header::CONTENT_SECURITY_POLICY, POLICY), (header::X_FRAME_OPTIONS, "DENY")];
    for (name, value) in policies.into_iter().filter(|_| !is_report) {
        headers.insert(name, HeaderValue::from_static(value));
    }
    let fixed = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (header::HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ];
    for (name, value) in fixed {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_refusals_has_a_line_a_second() {
        let (refusals, start) = (Refusals::default(), Instant::now());
        assert_eq!(refusals.count(start), Some(0));
        assert!((1..100).all(|i| refusals.count(start + Duration::from_millis(10 * i)).is_none()));
        assert_eq!(refusals.count(start + Duration::from_secs(1)), Some(99));
        assert_eq!(refusals.count(start + Duration::from_secs(3)), Some(0));
    }

    fn check(access: &Access, uri: &str, headers: &[(&'static str, &str)]) -> std::result::Result<String, Refusal> {
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(*name, HeaderValue::from_str(value).expect("a header"));
        }
        access.check(&uri.parse().expect("a URI"), &map).map(|uri| uri.to_string())
    }

    #[test]
    fn own_hosts_origins_and_the_token_are_accepted_only() {
        let token = Token::parse("0123456789abcdef").expect("a token");
        let local = Access { token: token.clone(), is_local: true, refusals: Arc::default() };
        let uri = "/0123456789abcdef/api/envs?x=1";
        for host in ["127.0.0.1:8000", "localhost:9", "[::1]:8000", "127.0.0.1"] {
            assert_eq!(check(&local, uri, &[("host", host)]), Ok("/api/envs?x=1".to_owned()), "{host}");
            let origin = format!("http://{host}");
            assert!(check(&local, uri, &[("host", host), ("origin", &origin)]).is_ok());
        }
        for host in
            ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "10.0.0.1:8000", "", "localhost.", "[::1"]
        {
            assert_eq!(check(&local, uri, &[("host", host)]), Err(Refusal::Host), "{host}");
        }
        assert_eq!(check(&local, uri, &[]), Err(Refusal::Host));
        assert_eq!(check(&local, uri, &[("host", "localhost"), ("host", "localhost")]), Err(Refusal::Host));
        for origin in ["http://evil.example", "null", "https://localhost", "http://localhost:1", ""] {
            assert_eq!(
                check(&local, uri, &[("host", "localhost"), ("origin", origin)]),
                Err(Refusal::Origin),
                "{origin}"
            );
        }
        let site = |site| check(&local, uri, &[("host", "localhost"), ("sec-fetch-site", site)]);
        assert_eq!([site("cross-site"), site("same-site")], [Err(Refusal::Origin), Err(Refusal::Origin)]);
        assert!(site("none").is_ok() && site("same-origin").is_ok());
        for uri in ["/", "/api/envs", "/0123456789abcdee/api/envs", "/0123456789abcdef", "//0123456789abcdef/"] {
            assert_eq!(check(&local, uri, &[("host", "localhost")]), Err(Refusal::Token), "{uri}");
        }
        let open = Access { token, is_local: false, refusals: Arc::default() };
        assert!(check(&open, uri, &[("host", "10.0.0.1:8000")]).is_ok());
        assert_eq!(check(&open, uri, &[("host", "evil.example:8000")]), Err(Refusal::Host));
    }

    #[test]
    fn tokens_are_random_and_short_ones_are_errors() {
        assert_ne!(Token::random().as_str(), Token::random().as_str());
        assert!(Token::parse(Token::random().as_str()).is_ok());
        assert!(["", "short", "0123456789abcde/", "0123456789 abcdef"].iter().all(|text| Token::parse(text).is_err()));
    }
}
