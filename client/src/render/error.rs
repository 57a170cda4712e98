//! Why there is no image.

/// Why an image could not be drawn or saved.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RenderError {
    /// Nothing on this machine can draw.
    #[error(
        "no graphics adapter found: install a Vulkan driver, e.g. the package mesa-vulkan-drivers (software rendering)"
    )]
    NoAdapter,
    /// There are adapters, but none of the name asked for.
    #[error("no graphics adapter named like \"{wanted}\"; there are: {available}")]
    NoSuchAdapter {
        /// Part of a name.
        wanted: String,
        /// Names of all adapters, separated by commas.
        available: String,
    },
    /// The adapter gave no device.
    #[error("graphics adapter \"{adapter}\" gave no device")]
    NoDevice {
        /// Name of the adapter.
        adapter: String,
        /// What it said.
        #[source]
        source: wgpu::RequestDeviceError,
    },
    /// The window gives nothing to draw to.
    #[error("cannot draw to this window: {0}")]
    NoSurface(String),
    /// The adapter cannot present to the window.
    #[error("graphics adapter \"{adapter}\" cannot show images in this window")]
    NoSurfaceFormat {
        /// Name of the adapter.
        adapter: String,
    },
    /// The image is empty or larger than the device's textures.
    #[error("an image of {width} x {height} pixels is out of range: this device draws 1 to {limit} per side")]
    ImageSize {
        /// Width asked for.
        width: u32,
        /// Height asked for.
        height: u32,
        /// Most pixels per side.
        limit: u32,
    },
    /// The mesh needs larger buffers than the device has.
    #[error("a mesh of {slots} vertex slots does not fit this device's buffers of {limit}: lower the triangle limit")]
    MeshTooLarge {
        /// Slots of the replica.
        slots: u32,
        /// Slots that fit.
        limit: u32,
    },
    /// The image did not come back from the device.
    #[error("reading the image back failed: {0}")]
    Readback(String),
    /// The image could not be encoded or written.
    #[error("writing the image failed")]
    Png(#[from] png::EncodingError),
    /// The file could not be created or written.
    #[error("writing the image failed")]
    Io(#[from] std::io::Error),
}
