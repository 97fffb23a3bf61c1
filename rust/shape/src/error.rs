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

    pub(crate) fn check_indices(what: &str, below: usize, indices: &[u32]) -> Result<(), Self> {
        match indices.iter().find(|&&index| index as usize >= below) {
            None => Ok(()),
            Some(index) => Err(Self(format!(
                "{what}: expected indices below {below}, found {index}"
            ))),
        }
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
