//! What a person can ask for besides moving the camera with a pointer: buttons, keys, links.

use crate::camera::UpAxis;
use crate::camera::navigate::StandardView;

/// What a tap does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tool {
    /// Nothing: the pointer only moves the camera.
    #[default]
    Look,
    /// It sets a mark on the surface; two marks make a distance.
    Measure,
    /// Nothing, and drags look around instead of turning the model.
    Fly,
}

/// One command.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Makes a setting, see [`Settings::set`](super::settings::Settings::set).
    Set {
        /// Its name.
        key: String,
        /// Its value as text.
        value: String,
    },
    /// Goes to a named view.
    View(StandardView),
    /// Shows the whole model.
    Fit,
    /// Puts the surface at a point of the image, in pixels, into the middle.
    Focus([f64; 2]),
    /// Parallel rays, or a pinhole.
    Orthographic(bool),
    /// Which axis is up.
    Up(UpAxis),
    /// What a tap does.
    Tool(Tool),
    /// Sets a mark at a point of the image, in pixels.
    Pick([f64; 2]),
    /// Goes on asking for the view as it is now, whose edges are drawn, while the camera looks at it from elsewhere.
    Freeze(bool),
    /// Removes the marks.
    ClearMarks,
    /// Goes to the view of a link, with its settings.
    Open(String),
    /// Begins to record the views.
    Record,
    /// Ends the recording: [`Event::Recorded`] follows.
    StopRecording,
    /// Plays a recording.
    Play(Vec<u8>),
    /// Stops playing.
    StopPlaying,
}

impl Command {
    /// The command of a name and a value; names that are none of a command are those of settings.
    pub fn parse(name: &str, value: &str) -> Option<Self> {
        let pixel = || {
            let (x, y) = value.split_once(',')?;
            Some([x.parse().ok()?, y.parse().ok()?])
        };
        Some(match name {
            "view" => Self::View(StandardView::ALL.into_iter().find(|view| view.name() == value)?),
            "fit" => Self::Fit,
            "focus" => Self::Focus(pixel()?),
            "ortho" => Self::Orthographic(value == "on"),
            "up" => Self::Up(if value == "z" { UpAxis::Z } else { UpAxis::Y }),
            "tool" => Self::Tool(match value {
                "measure" => Tool::Measure,
                "fly" => Tool::Fly,
                _ => Tool::Look,
            }),
            "pick" => Self::Pick(pixel()?),
            "freeze" => Self::Freeze(value == "on"),
            "clear" => Self::ClearMarks,
            "open" => Self::Open(value.into()),
            "record" if value == "on" => Self::Record,
            "record" => Self::StopRecording,
            "play" if value == "off" => Self::StopPlaying,
            "play" => Self::Play(value.into()),
            _ => Self::Set { key: name.into(), value: value.into() },
        })
    }
}

/// What happened that a person should hear of.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A mark was set or became exact: see [`Viewer::marks`](super::Viewer::marks).
    Marked,
    /// A sentence for a person.
    Notice(String),
    /// A recording is finished: the file.
    Recorded(Vec<u8>),
    /// A recording was played to its end or stopped.
    Played,
}
