//! Values of flags of which some are not available yet.

/// A closed set of values for a flag.
pub trait Choice: Copy + Send + Sync + 'static {
    /// The values that work, by name. The first is the default.
    const AVAILABLE: &'static [(&'static str, Self)];
    /// Names that will be values one day.
    const LATER: &'static [&'static str];
}

/// The value that `text` names, for clap.
///
/// # Errors
/// One line that says which values there are, and whether `text` will be one.
pub fn parse<C: Choice>(text: &str) -> Result<C, String> {
    if let Some((_, value)) = C::AVAILABLE.iter().find(|(name, _)| *name == text) {
        return Ok(*value);
    }
    let available: Vec<_> = C::AVAILABLE.iter().map(|(name, _)| format!("`{name}`")).collect();
    let reason = if C::LATER.contains(&text) { "not available yet" } else { "no such value" };
    Err(format!("{reason}; available: {}", available.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::ingest::Order;

    #[test]
    fn what_comes_later_is_told_from_what_never_comes() {
        assert_eq!(parse::<Order>("batched"), Ok(Order::Batched));
        assert_eq!(parse::<Order>("linear").unwrap_err(), "not available yet; available: `batched`");
        assert_eq!(parse::<Order>("best").unwrap_err(), "no such value; available: `batched`");
    }
}
