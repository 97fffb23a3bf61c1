//! Lengths of arrays.

use crate::OpsError;

/// # Errors
/// [`OpsError::LengthMismatch`].
pub(crate) fn check_length(name: &'static str, expected: usize, got: usize) -> Result<(), OpsError> {
    if expected == got {
        Ok(())
    } else {
        Err(OpsError::LengthMismatch { name, expected, got })
    }
}
