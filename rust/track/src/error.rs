use std::fmt;

/// Arrays that do not fit together: what, what was expected of it, what was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrackError(String);

impl TrackError {
    pub(crate) fn length(what: &str, expected: usize, found: usize) -> Self {
        Self(format!("{what}: expected {expected} values, found {found}"))
    }

    pub(crate) fn size(what: &str, found: usize, least: usize) -> Self {
        Self(format!("{what}: expected at least {least}, found {found}"))
    }
}

impl fmt::Display for TrackError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for TrackError {}
