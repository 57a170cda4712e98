//! What runs sessions: a driver for each, pools of threads that compute and that read for all, admission, the parking of sessions
//! whose connection broke, and shutdown.
//!
//! Sockets are [`http`](crate::http)'s business; what a session does with a frame is the [`Core`]'s.

pub mod admission;
pub mod driver;
pub mod memory;
pub mod metrics;
pub mod parking;
pub mod pool;
pub mod reader;
pub mod shutdown;

pub use admission::{Admission, Admitted, Full};
pub use driver::{Core, DriverSettings, SessionEnd, SessionReport, drive};
pub use memory::Memory;
pub use metrics::Metrics;
pub use parking::Parking;
pub use pool::{Pool, PoolError};
pub use reader::{PageReader, Reading};
pub use shutdown::Shutdown;

/// The threads that sessions share.
#[derive(Debug)]
pub struct Workers {
    /// They compute and never wait for the disk.
    pub pool: Pool,
    /// They read.
    pub reader: PageReader,
    /// What sessions add to.
    pub metrics: std::sync::Arc<Metrics>,
    /// What they may hold.
    pub memory: Memory,
    /// Those whose clients may come back.
    pub parking: std::sync::Arc<Parking>,
}

/// Runs `future` to its end on `io_threads` threads that serve sockets and timers, and stops whatever else they ran.
///
/// # Errors
/// The operating system's, when it gives no threads.
pub fn block_on<T>(io_threads: usize, future: impl Future<Output = T>) -> std::io::Result<T> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(io_threads)
        .thread_name("lodestream-io")
        .enable_all()
        .build()?;
    let output = runtime.block_on(future);
    runtime.shutdown_background();
    Ok(output)
}
