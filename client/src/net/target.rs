//! Addresses: from what a person types to where the stream is.

use std::fmt;
use std::str::FromStr;

/// The stream of one model on one server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Target {
    /// Host name or address, IPv6 without brackets.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// Path and query of the stream, beginning with a slash and ending in `/stream` before the query.
    pub path: String,
    /// Name of the model as it stands in the path.
    pub model: String,
}

/// Why an address is none of a model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TargetError {
    /// Not `http://` or `ws://`.
    #[error("'{0}' does not begin with http:// or ws://")]
    Scheme(String),
    /// Encryption is not built in.
    #[error("'{0}' asks for encryption, which this client does not have: use http://, or a local proxy")]
    Encrypted(String),
    /// No host, or a port that is none.
    #[error("'{0}' has no valid host and port")]
    Authority(String),
    /// The path does not name a model.
    #[error("'{0}' does not name a model: expected http://host:port/models/<id>")]
    Path(String),
}

impl FromStr for Target {
    type Err = TargetError;

    /// Reads `http://host[:port]/models/<id>`, also with `ws://`, a path before `/models` (a proxy's), a trailing slash or
    /// `/stream`, a query (kept) or a fragment (dropped).
    fn from_str(text: &str) -> Result<Self, TargetError> {
        let whole = || text.to_owned();
        let (scheme, rest) = text.split_once("://").ok_or_else(|| TargetError::Scheme(whole()))?;
        match scheme.to_ascii_lowercase().as_str() {
            "http" | "ws" => {}
            "https" | "wss" => return Err(TargetError::Encrypted(whole())),
            _ => return Err(TargetError::Scheme(whole())),
        }
        let rest = rest.split('#').next().expect("split yields at least one part");
        let (rest, query) = rest.split_once('?').map_or((rest, None), |(rest, query)| (rest, Some(query)));
        let (authority, path) = rest.split_once('/').unwrap_or((rest, ""));
        let (host, port) = parse_authority(authority).ok_or_else(|| TargetError::Authority(whole()))?;

        let path = path.strip_suffix('/').unwrap_or(path);
        let (before, model) = [Some(path), path.strip_suffix("/stream")]
            .into_iter()
            .flatten()
            .filter_map(|path| path.rsplit_once('/'))
            .find(|(before, _)| *before == "models" || before.ends_with("/models"))
            .filter(|(_, model)| !model.is_empty() && path.bytes().all(|byte| byte.is_ascii_graphic()))
            .ok_or_else(|| TargetError::Path(whole()))?;
        let query = query.map_or(String::new(), |query| format!("?{query}"));
        Ok(Self { host, port, path: format!("/{before}/{model}/stream{query}"), model: model.into() })
    }
}

fn parse_authority(authority: &str) -> Option<(String, u16)> {
    let (host, port) = match authority.strip_prefix('[') {
        Some(rest) => {
            let (host, rest) = rest.split_once(']')?;
            host.parse::<std::net::Ipv6Addr>().ok()?;
            (host, if rest.is_empty() { None } else { Some(rest.strip_prefix(':')?) })
        }
        None => authority.split_once(':').map_or((authority, None), |(host, port)| (host, Some(port))),
    };
    let is_host = |byte: u8| byte.is_ascii_alphanumeric() || b".-_:%".contains(&byte);
    let port = port.map_or(Some(80), |port| port.parse().ok())?;
    (!host.is_empty() && host.bytes().all(is_host) && port != 0).then(|| (host.into(), port))
}

impl Target {
    /// Path of the server's page of metrics, which lies beside `/models`. A query is dropped.
    pub fn metrics_path(&self) -> String {
        let path = self.path.split('?').next().unwrap_or_default();
        let model = path.strip_suffix("/stream").and_then(|path| path.rsplit_once('/'));
        let before = model.and_then(|(models, _)| models.strip_suffix("models")).unwrap_or("/");
        format!("{before}metrics")
    }

    /// `host:port`, with brackets around an IPv6 address.
    pub fn authority(&self) -> String {
        match self.host.contains(':') {
            true => format!("[{}]:{}", self.host, self.port),
            false => format!("{}:{}", self.host, self.port),
        }
    }
}

impl fmt::Display for Target {
    /// The WebSocket address.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ws://{}{}", self.authority(), self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_models_lead_to_their_streams() {
        let check = |text: &str, stream: &str, model: &str| {
            let target: Target = text.parse().unwrap_or_else(|error| panic!("{error}"));
            assert_eq!((target.to_string().as_str(), target.model.as_str()), (stream, model));
            assert_eq!(target.to_string().parse(), Ok(target));
        };
        check("http://127.0.0.1:8080/models/bunny", "ws://127.0.0.1:8080/models/bunny/stream", "bunny");
        check("http://127.0.0.1:8080/models/bunny/", "ws://127.0.0.1:8080/models/bunny/stream", "bunny");
        check("ws://host:1/models/a-b_c.1/stream", "ws://host:1/models/a-b_c.1/stream", "a-b_c.1");
        check("ws://host:1/models/x/stream/", "ws://host:1/models/x/stream", "x");
        check("HTTP://Host/models/x", "ws://Host:80/models/x/stream", "x");
        check("http://[::1]:9/models/x", "ws://[::1]:9/models/x/stream", "x");
        check("http://h/scans/models/x?token=1#view", "ws://h:80/scans/models/x/stream?token=1", "x");
        check("http://h/models/stream", "ws://h:80/models/stream/stream", "stream");
    }

    #[test]
    fn metrics_lie_beside_the_models() {
        let check = |text: &str, path: &str| assert_eq!(text.parse::<Target>().unwrap().metrics_path(), path);
        check("http://h/models/x", "/metrics");
        check("http://h/scans/models/x?token=1", "/scans/metrics");
        check("http://h/models/models", "/metrics");
    }

    #[test]
    fn other_addresses_are_refused_with_the_reason() {
        let check = |text: &str, error: fn(String) -> TargetError| {
            assert_eq!(text.parse::<Target>(), Err(error(text.into())));
        };
        check("bunny", TargetError::Scheme);
        check("ftp://host/models/x", TargetError::Scheme);
        check("https://host/models/x", TargetError::Encrypted);
        check("http:///models/x", TargetError::Authority);
        check("http://host:99999/models/x", TargetError::Authority);
        check("http://host:/models/x", TargetError::Authority);
        check("http://user@host/models/x", TargetError::Authority);
        check("http://[::1/models/x", TargetError::Authority);
        check("http://host", TargetError::Path);
        check("http://host/models", TargetError::Path);
        check("http://host/models/", TargetError::Path);
        check("http://host/other/x", TargetError::Path);
        check("http://host/models/x/y", TargetError::Path);
        check("http://host/models/a b", TargetError::Path);
    }
}
