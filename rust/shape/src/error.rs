use std::fmt;

/// Arrays that do not fit together: what, what was expected of it, what was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShapeError(String);

impl ShapeError {
    pub(crate) fn check(what: &str, expected: usize, found: usize) -> Result<(), Self> {
        if expected == found {
            return Ok(());
        }
        Err(Self(format!("{what}: expected {expected} values, found {found}")))
    }

    pub(crate) fn none(what: &str) -> Self {
        Self(format!("{what}: expected at least one value, found none"))
    }
}

impl fmt::Display for ShapeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for ShapeError {}
