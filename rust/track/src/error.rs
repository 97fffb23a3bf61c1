use std::fmt;

/// Arrays that do not fit together, or name what there is not: what, what was expected of it, what was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrackError(String);

impl TrackError {
    pub(crate) fn length(what: &str, expected: usize, found: usize) -> Self {
        Self(format!("{what}: expected {expected} values, found {found}"))
    }

    pub(crate) fn check_length(what: &str, expected: usize, found: usize) -> Result<(), Self> {
        if found == expected {
            Ok(())
        } else {
            Err(Self::length(what, expected, found))
        }
    }

    pub(crate) fn index(what: &str, expected: &str, found: i64) -> Self {
        Self(format!("{what}: expected {expected}, found {found}"))
    }

    pub(crate) fn level(error: &impl fmt::Display) -> Self {
        Self(error.to_string())
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
