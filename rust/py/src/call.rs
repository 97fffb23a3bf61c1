//! Runs work of the other crates: without the interpreter lock, in rayon's pool, a panic caught.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

/// Runs work without the interpreter lock; `told` makes its errors Python's. A panic, which would be a bug, becomes a
/// `RuntimeError` that begins with what failed, and so does a call in a forked process, which would wait for threads that
/// it does not have.
pub(crate) fn run<R: Send, E: Send>(
    py: Python<'_>,
    what: &str,
    told: impl FnOnce(E) -> PyErr,
    work: impl FnOnce() -> Result<R, E> + Send,
) -> PyResult<R> {
    static PROCESS: OnceLock<u32> = OnceLock::new();
    let process = std::process::id();
    if *PROCESS.get_or_init(|| process) != process {
        return Err(PyRuntimeError::new_err(format!(
            "{what}: expected the process that began to compute, found one forked from it, without its threads; \
             start worker processes by 'spawn'"
        )));
    }
    // Entered once: from outside, every stage would wake a thread of the pool and sleep until it is done.
    py.detach(|| catch_unwind(AssertUnwindSafe(|| rayon::scope(|_| work()))))
        .map_err(|_| PyRuntimeError::new_err(format!("{what} failed; please report this as a bug")))?
        .map_err(told)
}
