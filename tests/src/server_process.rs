//! The real binaries as child processes: a folder that goes away, a server that ends with its owner, and runs with a limit.
//!
//! Nothing here outlives its owner: children are killed by handle, files lie in a [`TempDir`]. Waits are polls with a deadline.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use lodestream_server::mesh::TriMesh;
use lodestream_server::mesh::export::{PlyOptions, write_ply};

/// How long a run may take, on a slow machine under load.
pub const RUN_LIMIT: Duration = Duration::from_secs(90);
/// How long a server may take to listen, and a socket to answer.
pub const ANSWER_LIMIT: Duration = Duration::from_secs(20);
/// Between two looks at something that is waited for.
const POLL: Duration = Duration::from_millis(5);

/// The server's executable: `SERVER_BIN`, or the one beside the running test.
///
/// # Panics
/// If it was not built.
pub fn server_bin() -> PathBuf {
    match std::env::var_os("SERVER_BIN") {
        Some(path) => built(path.into()),
        None => built(beside_the_test("lodestream-server")),
    }
}

/// The client's executable: beside `SERVER_BIN`, or beside the running test.
///
/// # Panics
/// If it was not built.
pub fn client_bin() -> PathBuf {
    let name = format!("lodestream{}", std::env::consts::EXE_SUFFIX);
    match std::env::var_os("SERVER_BIN") {
        Some(server) => built(Path::new(&server).with_file_name(name)),
        None => built(beside_the_test("lodestream")),
    }
}

fn beside_the_test(name: &str) -> PathBuf {
    let name = format!("{name}{}", std::env::consts::EXE_SUFFIX);
    // A test lies in `target/<profile>/deps`, a binary of this crate beside those of the others.
    let own = std::env::current_exe().expect("the system knows which program this is");
    let folder = own.parent().expect("a program lies in a folder");
    let above = folder.parent().expect("tests lie two folders below target");
    if folder.ends_with("deps") { above.join(name) } else { folder.join(name) }
}

fn built(path: PathBuf) -> PathBuf {
    assert!(path.is_file(), "there is no {}: run `cargo build --workspace --bins` first", path.display());
    path
}

/// A folder for temporary files, removed on drop.
#[derive(Debug)]
pub struct TempDir(PathBuf);

impl TempDir {
    /// An empty folder of its own.
    ///
    /// # Panics
    /// If it cannot be made.
    pub fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("lodestream-e2e-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(name);
        // What a killed process with the same number left behind.
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).expect("a folder for temporary files");
        Self(path)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// A path in it.
    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes a mesh as `<name>.ply`.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn write_mesh(&self, name: &str, mesh: &TriMesh) -> PathBuf {
        let path = self.join(&format!("{name}.ply"));
        let mut file = File::create(&path).expect("the folder takes a file");
        write_ply(mesh, &PlyOptions::default(), &mut file).expect("the file takes a mesh");
        path
    }
}

impl Default for TempDir {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for TempDir {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A child whose output is collected. Killed on drop.
#[derive(Debug)]
pub struct Running {
    child: Child,
    pipes: Option<[JoinHandle<Vec<u8>>; 2]>,
}

impl Running {
    /// Starts `program`.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start<A: AsRef<OsStr>>(program: &Path, args: impl IntoIterator<Item = A>) -> Self {
        let mut command = Command::new(program);
        command.args(args).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap_or_else(|error| panic!("cannot start {}: {error}", program.display()));
        let (mut stdout, mut stderr) = (child.stdout.take().expect("piped"), child.stderr.take().expect("piped"));
        let pipes = [
            std::thread::spawn(move || {
                let mut bytes = Vec::new();
                let _ = stdout.read_to_end(&mut bytes);
                bytes
            }),
            std::thread::spawn(move || {
                let mut bytes = Vec::new();
                let _ = stderr.read_to_end(&mut bytes);
                bytes
            }),
        ];
        Self { child, pipes: Some(pipes) }
    }

    /// Whether it has not ended.
    ///
    /// # Panics
    /// If the system does not say.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().expect("the child is ours").is_none()
    }

    /// Its exit status and output.
    ///
    /// # Panics
    /// If it has not ended within `limit`; it is killed then, and its output shown.
    pub fn wait(mut self, limit: Duration) -> Output {
        let is_over = poll_until(limit, || !self.is_running());
        let output = self.kill();
        assert!(is_over, "not over after {limit:?}: {}", described(&output));
        output
    }

    /// Kills it if it still runs.
    ///
    /// # Panics
    /// If it cannot be waited for.
    pub fn kill(&mut self) -> Output {
        let _ = self.child.kill();
        let status = self.child.wait().expect("the child is ours");
        let [stdout, stderr] = self.pipes.take().map_or_else(Default::default, |pipes| {
            pipes.map(|pipe| pipe.join().expect("reading a pipe does not panic"))
        });
        Output { status, stdout, stderr }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Looks until `is_done` says so or `limit` has passed, and says which.
pub fn poll_until(limit: Duration, mut is_done: impl FnMut() -> bool) -> bool {
    let deadline = Instant::now() + limit;
    while !is_done() {
        if Instant::now() >= deadline {
            return false;
        }
        std::thread::sleep(POLL);
    }
    true
}

/// An ended run, for messages of failed tests.
pub fn described(output: &Output) -> String {
    let text = String::from_utf8_lossy;
    format!("{}\nstdout: {}\nstderr: {}", output.status, text(&output.stdout), text(&output.stderr))
}

/// Runs a command of the server to its end.
pub fn server<A: AsRef<OsStr>>(args: impl IntoIterator<Item = A>) -> Output {
    Running::start(&server_bin(), args).wait(RUN_LIMIT)
}

/// Ingests files, each as the model of its stem.
///
/// # Panics
/// If the binary refuses one.
pub fn ingest(files: &[&Path], repository: &Path) {
    let words = [OsStr::new("ingest"), "--json".as_ref(), "--repository".as_ref(), repository.as_ref()];
    let output = server(words.into_iter().chain(files.iter().map(|file| file.as_os_str())));
    assert!(output.status.success(), "{}", described(&output));
}

/// Starts `lodestream snapshot`.
pub fn start_snapshot<A: AsRef<OsStr>>(url: &str, args: impl IntoIterator<Item = A>) -> Running {
    let mut words = vec![OsStr::new("snapshot").to_owned(), url.into()];
    words.extend(args.into_iter().map(|word| word.as_ref().to_owned()));
    Running::start(&client_bin(), words)
}

/// Runs `lodestream snapshot` to its end.
pub fn snapshot<A: AsRef<OsStr>>(url: &str, args: impl IntoIterator<Item = A>) -> Output {
    start_snapshot(url, args).wait(RUN_LIMIT)
}

/// `lodestream-server serve` on a free port. Killed on drop.
#[derive(Debug)]
pub struct ServerProcess {
    child: Child,
    authority: String,
    log: PathBuf,
    _folder: TempDir,
}

impl ServerProcess {
    /// Serves a repository and waits until clients can come.
    ///
    /// # Panics
    /// If it does not say that it listens within [`ANSWER_LIMIT`]; shows what it logged.
    pub fn start(repository: &Path) -> Self {
        Self::start_with(repository, &[])
    }

    /// [`start`](Self::start) with environment variables, which is one way to configure it.
    ///
    /// # Panics
    /// As there.
    pub fn start_with(repository: &Path, variables: &[(&str, &str)]) -> Self {
        let folder = TempDir::new();
        let log = folder.join("stderr");
        let mut command = Command::new(server_bin());
        command.args(["serve", "--listen", "127.0.0.1:0", "--repository"]).arg(repository).stdin(Stdio::null());
        command.envs(variables.iter().copied());
        command.stdout(Stdio::piped()).stderr(File::create(&log).expect("the folder takes a file"));
        let mut child = command.spawn().expect("the server starts");
        let stdout = BufReader::new(child.stdout.take().expect("piped"));
        let mut server = Self { child, authority: String::new(), log, _folder: folder };
        let (line, ready) = mpsc::channel();
        // Ends with the child, whose standard output it holds.
        std::thread::spawn(move || stdout.lines().map_while(Result::ok).try_for_each(|text| line.send(text)));
        let ready = ready.recv_timeout(ANSWER_LIMIT);
        let authority = ready.as_deref().ok().and_then(|line| line.strip_prefix("listening on http://"));
        server.authority = authority.unwrap_or_else(|| panic!("no ready line: {ready:?}\n{}", server.log())).to_owned();
        server
    }

    /// Host and port.
    pub fn authority(&self) -> &str {
        &self.authority
    }

    /// Address of a model.
    pub fn url(&self, model: &str) -> String {
        format!("http://{}/models/{model}", self.authority)
    }

    /// What it logged so far.
    pub fn log(&self) -> String {
        std::fs::read(&self.log).map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).unwrap_or_default()
    }

    /// Waits until the log holds `text` so often.
    ///
    /// # Panics
    /// If that takes longer than [`ANSWER_LIMIT`].
    pub fn wait_for_log(&self, text: &str, count: usize) {
        let is_there = poll_until(ANSWER_LIMIT, || self.log().matches(text).count() >= count);
        assert!(is_there, "{count} x {text:?} is not in the log:\n{}", self.log());
    }

    /// Status line, head and body that a plain GET brings.
    ///
    /// # Panics
    /// If there is no answer within [`ANSWER_LIMIT`].
    pub fn get(&self, path: &str) -> String {
        let mut socket = TcpStream::connect(&self.authority).expect("the server accepts connections");
        socket.set_read_timeout(Some(ANSWER_LIMIT)).expect("a timeout above zero");
        write!(socket, "GET {path} HTTP/1.1\r\nhost: {}\r\nconnection: close\r\n\r\n", self.authority)
            .expect("the server takes a request");
        let mut answer = Vec::new();
        socket.read_to_end(&mut answer).expect("the server answers");
        String::from_utf8_lossy(&answer).into_owned()
    }

    /// That it is alive, and that nothing in it panicked.
    ///
    /// # Panics
    /// If not.
    pub fn check_healthy(&mut self) {
        let exit = self.child.try_wait().expect("the child is ours");
        assert_eq!(exit, None, "the server is gone:\n{}", self.log());
        let answer = self.get("/healthz");
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        assert!(!self.log().contains("panicked"), "{}", self.log());
    }

    /// Asks it to end, as a service manager does.
    ///
    /// # Panics
    /// If no signal can be sent.
    pub fn terminate(&self) {
        let status = Command::new("kill").args(["-TERM", &self.child.id().to_string()]).status();
        assert!(status.expect("the system has `kill`").success());
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// If it still runs after [`ANSWER_LIMIT`].
    pub fn wait(&mut self) -> ExitStatus {
        let is_over = poll_until(ANSWER_LIMIT, || self.child.try_wait().expect("the child is ours").is_some());
        assert!(is_over, "the server does not end:\n{}", self.log());
        self.child.wait().expect("the child is ours")
    }

    /// Ends it without a chance to say goodbye.
    pub fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        self.kill();
        if std::thread::panicking() {
            eprintln!("the server logged:\n{}", self.log());
        }
    }
}
