//! What a pack says about itself for people.

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Title, origin and reports; JSON in the file. Holds no time, so that the same input gives the same bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Metadata {
    /// Name for people, at most [`MAX_TEXT_BYTES`](lodestream_protocol::limits::MAX_TEXT_BYTES) bytes; may be empty.
    pub title: String,
    /// Licence of the model, may be empty.
    pub license: String,
    /// Where the model comes from, may be empty.
    pub source: String,
    /// Software and version that wrote the pack.
    pub created_by: String,
    /// Edges whose faces meet at a larger angle than this are drawn sharp, 0 to 180 degrees.
    pub crease_angle_deg: f32,
    /// File beside the pack that holds the input as it was, empty if it was not kept.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub original: String,
    /// Report of reading the input.
    pub read_report: Value,
    /// Report of cleaning it.
    pub clean_report: Value,
    /// Report of simplification and hierarchy, with the options used.
    pub build_report: Value,
    /// Not stored: whether the writer leaves room in the section table for the thumbnail that is drawn from the finished pack.
    #[serde(skip)]
    pub leaves_room_for_thumbnail: bool,
}

impl Default for Metadata {
    fn default() -> Self {
        Self {
            title: String::new(),
            license: String::new(),
            source: String::new(),
            created_by: concat!("lodestream ", env!("CARGO_PKG_VERSION")).into(),
            crease_angle_deg: 180.0,
            original: String::new(),
            read_report: Value::Null,
            clean_report: Value::Null,
            build_report: Value::Null,
            leaves_room_for_thumbnail: false,
        }
    }
}

impl Metadata {
    /// What both writer and reader refuse.
    pub(super) fn check(&self) -> Result<(), &'static str> {
        if self.title.len() > lodestream_protocol::limits::MAX_TEXT_BYTES {
            return Err("the title is too long");
        }
        if !(0.0..=180.0).contains(&self.crease_angle_deg) {
            return Err("the crease angle is not between 0 and 180 degrees");
        }
        Ok(())
    }
}
