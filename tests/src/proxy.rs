//! A TCP proxy that loses its connections when told to: a train that goes into a tunnel.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

/// Forwards connections on a port of its own. To be used where a tokio runtime runs.
#[derive(Debug)]
pub struct Proxy {
    address: SocketAddr,
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    target: watch::Sender<String>,
    /// Counts the cuts, and how many of them left the sockets open.
    cuts: watch::Sender<(u64, bool)>,
    /// Bytes from the server that may still pass before the next cut.
    left: AtomicU64,
}

impl Proxy {
    /// Listens on a free port and forwards to `target`, as `host:port`.
    ///
    /// # Panics
    /// If there is no port.
    pub async fn start(target: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("it is bound");
        let shared = Arc::new(Shared {
            target: watch::Sender::new(target.to_owned()),
            cuts: watch::Sender::new((0, false)),
            left: AtomicU64::new(u64::MAX),
        });
        tokio::spawn({
            let shared = Arc::clone(&shared);
            async move {
                while let Ok((client, _)) = listener.accept().await {
                    let shared = Arc::clone(&shared);
                    tokio::spawn(async move { shared.forward(client).await });
                }
            }
        });
        Self { address, shared }
    }

    /// Address of a model behind the proxy.
    pub fn url(&self, model: &str) -> String {
        format!("http://{}/models/{model}", self.address)
    }

    /// Connections from now on go there.
    pub fn set_target(&self, target: &str) {
        self.shared.target.send_replace(target.to_owned());
    }

    /// Drops all connections.
    pub fn cut(&self) {
        self.shared.cuts.send_modify(|cuts| *cuts = (cuts.0 + 1, false));
    }

    /// Drops all connections after so many bytes from the server, frames in the middle.
    pub fn cut_after(&self, bytes: u64) {
        self.shared.left.store(bytes, Ordering::Relaxed);
    }

    /// From now on nothing passes on the connections that there are, and both ends see them open.
    pub fn freeze(&self) {
        self.shared.cuts.send_modify(|cuts| *cuts = (cuts.0 + 1, true));
    }
}

impl Shared {
    async fn forward(&self, client: TcpStream) {
        let mut cuts = self.cuts.subscribe();
        let target = self.target.borrow().clone();
        let Ok(server) = TcpStream::connect(target).await else { return };
        // Segments pass as they come.
        let _ = (client.set_nodelay(true), server.set_nodelay(true));
        let (from_client, to_client) = client.into_split();
        let (from_server, to_server) = server.into_split();
        let (mut up, mut down) = (Lane(from_client, to_server), Lane(from_server, to_client));
        let unlimited = AtomicU64::new(u64::MAX);
        let is_frozen = tokio::select! {
            _ = cuts.changed() => cuts.borrow().1,
            () = up.run(&unlimited) => false,
            () = down.run(&self.left) => {
                if self.left.load(Ordering::Relaxed) == 0 {
                    self.left.store(u64::MAX, Ordering::Relaxed);
                }
                false
            }
        };
        if is_frozen {
            std::future::pending().await
        }
    }
}

struct Lane(OwnedReadHalf, OwnedWriteHalf);

impl Lane {
    async fn run(&mut self, left: &AtomicU64) {
        let mut bytes = vec![0; 4096];
        loop {
            let Ok(count @ 1..) = self.0.read(&mut bytes).await else { return };
            let before = left.load(Ordering::Relaxed);
            let passing = usize::try_from(before).unwrap_or(usize::MAX).min(count);
            if before != u64::MAX {
                left.store(before - passing as u64, Ordering::Relaxed);
            }
            if self.1.write_all(&bytes[..passing]).await.is_err() || passing < count {
                return;
            }
        }
    }
}
