//! Runs work of the other crates: without the interpreter lock, in one of rayon's pools, a panic caught.

use std::cell::Cell;
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
    join_pool(py)?;
    // Entered once: from outside, every stage would wake a thread of the pool and sleep until it is done.
    py.detach(|| catch_unwind(AssertUnwindSafe(|| rayon::scope(|_| work()))))
        .map_err(|_| PyRuntimeError::new_err(format!("{what} failed; please report this as a bug")))?
        .map_err(told)
}

/// Makes Python's main thread a worker of a pool of its own, when it first calls.
///
/// It need not wake another thread then to do what it waits for, and what is left for others they find it busy with: where
/// it slept instead, a virtual machine's scheduler often let two workers take turns on one processor. Threads that come and
/// go, and those that call while the main one does something else, share the global pool.
fn join_pool(py: Python<'_>) -> PyResult<()> {
    thread_local!(static ASKED: Cell<bool> = const { Cell::new(false) });
    if ASKED.replace(true) {
        return Ok(());
    }
    let threading = py.import("threading")?;
    let main = threading.call_method0("main_thread")?;
    if threading.call_method0("current_thread")?.is(&main) {
        // Where no thread can be started the call itself will say so.
        if let Ok(pool) = rayon::ThreadPoolBuilder::new().use_current_thread().build() {
            // It lives as long as the thread.
            std::mem::forget(pool);
        }
    }
    Ok(())
}
