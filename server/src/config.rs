//! What can be configured: a TOML file, environment variables over it, flags over both.
//!
//! A variable is named `LODESTREAM_<SECTION>_<KEY>`, for example `LODESTREAM_RUNTIME_MAX_SESSIONS=100`; lists are separated
//! by commas. [`Config`] is turned once into the checked types that the rest receives; nothing below reads a file or a
//! variable. `deploy/server.toml` lists every key.

use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Duration;

use lodestream_protocol::limits::MAX_CACHE_ENTRIES;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::http::Settings;
use crate::runtime::DriverSettings;
use crate::session::SessionConfig;
use crate::telemetry::LogFormat;

const VARIABLE_PREFIX: &str = "LODESTREAM_";

const MAX_RESUME_S: u32 = 24 * 60 * 60;

/// All of the configuration.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Sockets and requests.
    pub http: HttpSection,
    /// Sessions and threads.
    pub runtime: RuntimeSection,
    /// What one session may use.
    pub session: SessionSection,
    /// Logs.
    pub log: LogSection,
}

/// `[http]`: sockets and requests.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HttpSection {
    /// Address and port to listen on; port 0 takes a free one. Default `127.0.0.1:8080`: this machine only.
    pub listen: SocketAddr,
    /// Origins of web pages, other than the server's own, that may open streams, as `https://example.org`; `*` allows all.
    /// Default: none.
    pub allowed_origins: Vec<String>,
    /// Connections that have not become streams. More wait to be accepted, so a flood slows new clients but takes no
    /// memory. Default 768: together with the sessions it stays below 1,024 open files.
    pub max_connections: u32,
    /// Seconds that a client may take to send a request's head, and that an idle connection is kept. Default 15.
    pub header_timeout_s: u32,
    /// Seconds between two pings on a stream. Default 20: below the minute after which many proxies give up.
    pub ping_interval_s: u32,
    /// Seconds after which a stream that sends nothing, not even an answer to a ping, is closed. Default 60.
    pub idle_timeout_s: u32,
    /// Seconds that the network may take to accept one frame of a stream before it is closed. Default 60.
    pub write_timeout_s: u32,
    /// Seconds that a stream may take to say goodbye once it is closed. Default 2.
    pub close_timeout_s: u32,
}

impl Default for HttpSection {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            allowed_origins: Vec::new(),
            max_connections: 768,
            header_timeout_s: 15,
            ping_interval_s: 20,
            idle_timeout_s: 60,
            write_timeout_s: 60,
            close_timeout_s: 2,
        }
    }
}

/// `[runtime]`: sessions and threads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RuntimeSection {
    /// Sessions open at once; more are refused with status 503. A session takes memory in proportion to its client's mesh.
    /// Default 200.
    pub max_sessions: u32,
    /// Bytes of memory that all sessions may hold together. From three quarters of it on, sessions whose view has settled rest
    /// at once; from all of it on, new sessions are refused with status 503. Default 4294967296.
    pub max_session_bytes: u64,
    /// Threads that choose and encode what is sent: a number, or `"auto"` for as many as the machine has cores. Default
    /// `"auto"`.
    pub compute_threads: Threads,
    /// Threads that read pages of models for the sessions: the requests that the disk is given at once. Default 2.
    pub reader_threads: u32,
    /// Threads that serve sockets. They only move bytes. Default 2.
    pub io_threads: u32,
    /// Seconds after the upgrade within which a client must send its first frame. Default 10.
    pub hello_timeout_s: u32,
    /// Frames from one client that may wait for its session; then its socket is not read. Default 8.
    pub inbound_frames: u32,
    /// Frames for one client that may wait for its socket; then nothing is computed for it. Few, so that what is sent
    /// answers the newest view. Default 2.
    pub outbound_frames: u32,
    /// Seconds that a shutdown waits for sessions to close. Default 10.
    pub shutdown_deadline_s: u32,
}

impl Default for RuntimeSection {
    fn default() -> Self {
        Self {
            max_sessions: 200,
            max_session_bytes: 4 << 30,
            compute_threads: Threads::Auto,
            reader_threads: 2,
            io_threads: 2,
            hello_timeout_s: 10,
            inbound_frames: 8,
            outbound_frames: 2,
            shutdown_deadline_s: 10,
        }
    }
}

/// `[session]`: what one session may use.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SessionSection {
    /// Most entries of the op cache that server and client mirror, whatever the client asks for. An entry saves a transfer
    /// when the view returns and takes some tens of bytes at both ends. Default 131072.
    pub max_cache_entries: u32,
    /// Most bytes under way to one client, whatever its link. More fills fat links with long round trips; all of it may be
    /// stale when the view changes. Default 1048576.
    pub max_window_bytes: u32,
    /// Most bytes of memory that a session may hold. Triangle limits of views are lowered to a 160th of it; a session that
    /// passes it all the same is closed with code 4003. Default 2147483648.
    pub max_bytes: u64,
    /// Seconds without a new view after which a session whose view has settled drops its mirror of the client's mesh: some 5 bytes
    /// for each vertex instead of 100 stay, and the next view waits until it is rebuilt, some microseconds for each vertex.
    /// Where memory runs short, sessions rest without waiting (`runtime.max_session_bytes`). Default 30.
    pub rest_after_s: u32,
    /// Seconds that a session whose connection broke is kept for its client to come back, 0 for not at all. Such sessions drop their
    /// mirrors and keep what was not acknowledged. At most `runtime.max_sessions` are kept beside those that are open; their memory
    /// counts in `runtime.max_session_bytes`, and they give way to new sessions there. Default 60.
    pub resume_s: u32,
}

impl Default for SessionSection {
    fn default() -> Self {
        let SessionConfig { max_cache_entries, max_window_bytes, .. } = SessionConfig::default();
        Self {
            max_cache_entries,
            max_window_bytes,
            max_bytes: SessionConfig::default().max_bytes,
            rest_after_s: 30,
            resume_s: 60,
        }
    }
}

/// `[log]`: what is logged and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LogSection {
    /// `"human"`, `"json"`, or `"auto"`: for people on a terminal, JSON otherwise. Default `"auto"`.
    pub format: LogFormat,
    /// Lowest level logged, overall or by module, as in `info,lodestream_server::http=debug`. Default `info`.
    pub filter: String,
}

impl Default for LogSection {
    fn default() -> Self {
        Self { format: LogFormat::Auto, filter: "info".into() }
    }
}

/// A number of threads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged, expecting = "expected a positive number of threads or \"auto\"")]
pub enum Threads {
    /// So many.
    Number(NonZeroUsize),
    /// As many as the machine has cores.
    #[serde(with = "auto")]
    Auto,
}

/// The word `"auto"`.
mod auto {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub(super) fn serialize<S: Serializer>(serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str("auto")
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<(), D::Error> {
        match String::deserialize(deserializer)?.as_str() {
            "auto" => Ok(()),
            _ => Err(D::Error::custom("expected \"auto\"")),
        }
    }
}

impl Threads {
    fn number(self) -> NonZeroUsize {
        match self {
            Self::Number(number) => number,
            Self::Auto => std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN),
        }
    }
}

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The operating system's reason.
        #[source]
        source: std::io::Error,
    },
    /// The file is no configuration.
    #[error("{path}: {reason}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Line and reason.
        reason: String,
    },
    /// An environment variable names no key, or its value does not fit.
    #[error("environment variable {name}: {reason}")]
    Variable {
        /// The variable.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// A value makes no sense.
    #[error("configuration: {key} {reason}")]
    Value {
        /// Section and key.
        key: &'static str,
        /// What is wrong.
        reason: String,
    },
}

impl Config {
    /// The defaults, `file` over them, and the `LODESTREAM_...` ones of `variables` over both.
    ///
    /// Variables whose first word is no section (`LODESTREAM_MESHES`) mean something else and are left alone.
    ///
    /// # Errors
    /// [`ConfigError`] names the file or the variable.
    pub fn load(
        file: Option<&Path>,
        variables: impl IntoIterator<Item = (String, String)>,
    ) -> Result<Self, ConfigError> {
        let mut config = match file {
            Some(path) => Self::parse_file(path)?,
            None => Self::default(),
        };
        for (name, value) in variables {
            let Some((section, key)) = name.strip_prefix(VARIABLE_PREFIX).and_then(|rest| rest.split_once('_')) else {
                continue;
            };
            let (section, key) = (section.to_lowercase(), key.to_lowercase());
            config.set(&section, &key, &value).map_err(|reason| ConfigError::Variable { name, reason })?;
        }
        Ok(config)
    }

    fn parse_file(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.into(), source })?;
        toml::from_str(&text).map_err(|error| {
            let line = error.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
            ConfigError::File { path: path.into(), reason: format!("line {line}: {}", error.message()) }
        })
    }

    fn set(&mut self, section: &str, key: &str, text: &str) -> Result<(), String> {
        let mut table = Table::try_from(&*self).map_err(|error| error.to_string())?;
        let Some(Value::Table(keys)) = table.get_mut(section) else {
            return Ok(());
        };
        let Some(value) = keys.get_mut(key) else {
            return Err(format!("there is no key `{key}` in section [{section}]"));
        };
        let number = || text.trim().parse().map(Value::Integer);
        *value = match value {
            Value::Array(_) => {
                let items = text.split(',').map(str::trim).filter(|item| !item.is_empty());
                Value::Array(items.map(|item| Value::String(item.into())).collect())
            }
            Value::Integer(_) => number().map_err(|_| format!("`{text}` is no number"))?,
            // Threads may be either, and no other text consists of digits.
            _ => number().unwrap_or_else(|_| Value::String(text.into())),
        };
        *self = table.try_into().map_err(|error: toml::de::Error| error.message().trim().to_owned())?;
        Ok(())
    }

    /// The checked settings of the server.
    ///
    /// # Errors
    /// [`ConfigError::Value`] names the first key whose value makes no sense.
    pub fn settings(&self) -> Result<Settings, ConfigError> {
        let Self { http, runtime, .. } = self;
        let refuse = |key, reason: &str| Err(ConfigError::Value { key, reason: reason.into() });
        for (key, value) in [
            ("http.max_connections", http.max_connections),
            ("http.header_timeout_s", http.header_timeout_s),
            ("http.ping_interval_s", http.ping_interval_s),
            ("http.idle_timeout_s", http.idle_timeout_s),
            ("http.write_timeout_s", http.write_timeout_s),
            ("http.close_timeout_s", http.close_timeout_s),
            ("runtime.max_sessions", runtime.max_sessions),
            ("runtime.reader_threads", runtime.reader_threads),
            ("runtime.io_threads", runtime.io_threads),
            ("runtime.hello_timeout_s", runtime.hello_timeout_s),
            ("runtime.inbound_frames", runtime.inbound_frames),
            ("runtime.outbound_frames", runtime.outbound_frames),
            ("runtime.shutdown_deadline_s", runtime.shutdown_deadline_s),
        ] {
            if value == 0 {
                return refuse(key, "must be at least 1");
            }
        }
        if runtime.max_session_bytes == 0 {
            return refuse("runtime.max_session_bytes", "must be at least 1");
        }
        if http.idle_timeout_s <= http.ping_interval_s {
            return refuse(
                "http.idle_timeout_s",
                "must be longer than http.ping_interval_s, or quiet clients are closed",
            );
        }
        // The queue types of tokio take up to 2^61 permits, but nobody means more than these.
        for (key, value, most) in [
            ("http.max_connections", http.max_connections, 1 << 20),
            ("runtime.max_sessions", runtime.max_sessions, 1 << 20),
            ("runtime.reader_threads", runtime.reader_threads, 1024),
            ("runtime.io_threads", runtime.io_threads, 1024),
            ("runtime.inbound_frames", runtime.inbound_frames, 1024),
            ("runtime.outbound_frames", runtime.outbound_frames, 1024),
        ] {
            if value > most {
                return refuse(key, &format!("must be at most {most}"));
            }
        }
        if runtime.compute_threads.number().get() > 1024 {
            return refuse("runtime.compute_threads", "must be at most 1024");
        }
        if self.session.resume_s > MAX_RESUME_S {
            return refuse("session.resume_s", &format!("must be at most {MAX_RESUME_S}, a day"));
        }
        if let Some(origin) = http.allowed_origins.iter().find(|origin| !is_origin(origin)) {
            return refuse(
                "http.allowed_origins",
                &format!("holds `{origin}`; an origin is `https://host`, with the port if it is unusual and no path"),
            );
        }
        let seconds = |s: u32| Duration::from_secs(s.into());
        Ok(Settings {
            allowed_origins: http.allowed_origins.clone(),
            max_connections: http.max_connections,
            max_sessions: runtime.max_sessions,
            max_session_bytes: runtime.max_session_bytes,
            resume_for: seconds(self.session.resume_s),
            compute_threads: runtime.compute_threads.number(),
            reader_threads: NonZeroUsize::new(runtime.reader_threads as usize).unwrap_or(NonZeroUsize::MIN),
            header_timeout: seconds(http.header_timeout_s),
            ping_interval: seconds(http.ping_interval_s),
            idle_timeout: seconds(http.idle_timeout_s),
            write_timeout: seconds(http.write_timeout_s),
            close_timeout: seconds(http.close_timeout_s),
            shutdown_deadline: seconds(runtime.shutdown_deadline_s),
            driver: DriverSettings {
                hello_timeout: seconds(runtime.hello_timeout_s),
                inbound_frames: runtime.inbound_frames as usize,
                outbound_frames: runtime.outbound_frames as usize,
            },
        })
    }

    /// The checked configuration of sessions.
    ///
    /// # Errors
    /// [`ConfigError::Value`] names the first key whose value makes no sense.
    pub fn session(&self) -> Result<SessionConfig, ConfigError> {
        let SessionSection { max_cache_entries, max_window_bytes, max_bytes, rest_after_s, .. } = self.session;
        if max_cache_entries > MAX_CACHE_ENTRIES {
            return Err(ConfigError::Value {
                key: "session.max_cache_entries",
                reason: format!("must be at most {MAX_CACHE_ENTRIES}, which the protocol allows"),
            });
        }
        if max_window_bytes == 0 {
            return Err(ConfigError::Value { key: "session.max_window_bytes", reason: "must be at least 1".into() });
        }
        if max_bytes == 0 {
            return Err(ConfigError::Value { key: "session.max_bytes", reason: "must be at least 1".into() });
        }
        Ok(SessionConfig {
            max_cache_entries,
            max_window_bytes,
            max_bytes,
            rest_after: Duration::from_secs(rest_after_s.into()),
        })
    }
}

fn is_origin(text: &str) -> bool {
    text == "*"
        || ["http://", "https://"]
            .iter()
            .filter_map(|scheme| text.strip_prefix(scheme))
            .any(|host| !host.is_empty() && !host.contains(['/', '?', '#', '@', ' ']) && host == host.to_lowercase())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SAMPLE: &str = include_str!("../../deploy/server.toml");

    fn load(variables: &[(&str, &str)]) -> Result<Config, ConfigError> {
        Config::load(None, variables.iter().map(|&(name, value)| (name.into(), value.into())))
    }

    fn parse(text: &str) -> Result<Config, String> {
        let path =
            std::env::temp_dir().join(format!("lodestream-config-{}-{}.toml", std::process::id(), fastrand::u64(..)));
        std::fs::write(&path, text).unwrap();
        let config = Config::load(Some(&path), []);
        std::fs::remove_file(&path).unwrap();
        config.map_err(|error| error.to_string().replace(&path.display().to_string(), "FILE"))
    }

    #[test]
    fn the_sample_lists_every_key_at_its_default() {
        assert_eq!(parse(SAMPLE).unwrap(), Config::default());
        let (sample, defaults): (Table, _) =
            (toml::from_str(SAMPLE).unwrap(), Table::try_from(Config::default()).unwrap());
        assert_eq!(sample, defaults, "a missing key parses as its default, so the tables are compared too");
        for line in SAMPLE.lines().filter(|line| line.contains(" = ")) {
            let (before, _) = SAMPLE.split_once(&format!("\n{line}")).unwrap();
            assert!(before.lines().last().unwrap().starts_with('#'), "`{line}` has no comment above it");
        }
    }

    #[test]
    fn variables_go_over_the_file_and_the_file_over_defaults() {
        let config = load(&[
            ("LODESTREAM_HTTP_LISTEN", "0.0.0.0:80"),
            ("LODESTREAM_HTTP_ALLOWED_ORIGINS", "https://a.org, https://b.org"),
            ("LODESTREAM_RUNTIME_MAX_SESSIONS", "7"),
            ("LODESTREAM_RUNTIME_COMPUTE_THREADS", "3"),
            ("LODESTREAM_LOG_FORMAT", "json"),
            ("LODESTREAM_MESHES", "/somewhere"),
            ("LODESTREAM_OTHER_THING", "x"),
            ("HOME", "/home"),
        ])
        .unwrap();
        assert_eq!(config.http.listen, SocketAddr::from(([0, 0, 0, 0], 80)));
        assert_eq!(config.http.allowed_origins, ["https://a.org", "https://b.org"]);
        assert_eq!(config.runtime.max_sessions, 7);
        assert_eq!(config.settings().unwrap().compute_threads.get(), 3);
        assert_eq!(config.log.format, LogFormat::Json);
        assert_eq!(parse("[runtime]\nmax_sessions = 5\n").unwrap().runtime.max_sessions, 5);
    }

    #[test]
    fn mistakes_are_named() {
        let message = |name, value| load(&[(name, value)]).unwrap_err().to_string();
        assert_eq!(
            message("LODESTREAM_HTTP_PORT", "80"),
            "environment variable LODESTREAM_HTTP_PORT: there is no key `port` in section [http]"
        );
        assert!(message("LODESTREAM_RUNTIME_MAX_SESSIONS", "many").ends_with("`many` is no number"));
        assert!(message("LODESTREAM_RUNTIME_COMPUTE_THREADS", "0").ends_with("number of threads or \"auto\""));
        assert!(message("LODESTREAM_HTTP_LISTEN", "nowhere").contains("LODESTREAM_HTTP_LISTEN"));
        let error = parse("[http]\n\nport = 80\n").unwrap_err();
        assert!(error.starts_with("FILE: line 3: unknown field `port`"), "{error}");

        let mut config = Config::default();
        config.http.ping_interval_s = 60;
        assert!(config.settings().unwrap_err().to_string().starts_with("configuration: http.idle_timeout_s must be"));
        config = Config::default();
        config.runtime.outbound_frames = 0;
        assert!(config.settings().unwrap_err().to_string().ends_with("runtime.outbound_frames must be at least 1"));
        config = Config::default();
        config.http.allowed_origins = vec!["https://a.org/".into()];
        assert!(config.settings().is_err());
        config = Config::default();
        config.session.resume_s = u32::MAX;
        assert!(config.settings().unwrap_err().to_string().contains("session.resume_s must be at most 86400"));
        config = Config::default();
        config.session.max_cache_entries = u32::MAX;
        assert!(config.session().is_err());
    }

    #[test]
    fn defaults_are_valid_and_agree_with_the_session() {
        assert!(Config::default().settings().is_ok());
        assert_eq!(Config::default().session().unwrap(), SessionConfig::default());
    }
}
