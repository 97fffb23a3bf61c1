//! Buffers that outlive a call, so that a render in a loop allocates nothing.
//!
//! A call borrows its buffers from one process-wide pool and gives them back when it, or the state it returns, is
//! dropped. What the pool may hold is bounded; buffers keep their capacity, and nothing may rely on what they contain.

use std::any::Any;
use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Idle bytes that the pool keeps at most.
const IDLE_BYTES: usize = 1 << 29;
/// Idle sets of buffers that the pool keeps at most.
const IDLE_SETS: usize = 64;

/// A set of buffers that can be used again.
pub(crate) trait Buffers: Any + Default + Send {
    /// Bytes set aside, used or not.
    fn bytes(&self) -> usize;
}

/// The idle sets of all kinds: a `Vec<B>` for every kind B seen so far.
struct Idle {
    shelves: Vec<Box<dyn Any + Send>>,
    sets: usize,
    bytes: usize,
}

static IDLE: Mutex<Idle> = Mutex::new(Idle {
    shelves: Vec::new(),
    sets: 0,
    bytes: 0,
});

fn idle() -> MutexGuard<'static, Idle> {
    // A panic elsewhere cannot leave this half changed, so a poisoned lock is as good as a sound one.
    IDLE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Buffers on loan from the pool.
#[derive(Debug)]
pub(crate) struct Pooled<B: Buffers>(B);

impl<B: Buffers> Pooled<B> {
    /// The buffers of this kind that came back last, or new ones.
    pub(crate) fn take() -> Self {
        let mut idle = idle();
        let shelf = idle
            .shelves
            .iter_mut()
            .find_map(|shelf| shelf.downcast_mut::<Vec<B>>());
        let Some(set) = shelf.and_then(Vec::pop) else {
            return Self(B::default());
        };
        idle.sets -= 1;
        idle.bytes -= set.bytes();
        Self(set)
    }
}

impl<B: Buffers> Deref for Pooled<B> {
    type Target = B;
    fn deref(&self) -> &B {
        &self.0
    }
}

impl<B: Buffers> DerefMut for Pooled<B> {
    fn deref_mut(&mut self) -> &mut B {
        &mut self.0
    }
}

impl<B: Buffers> Drop for Pooled<B> {
    fn drop(&mut self) {
        let set = std::mem::take(&mut self.0);
        let bytes = set.bytes();
        let mut idle = idle();
        if idle.sets == IDLE_SETS || idle.bytes + bytes > IDLE_BYTES {
            drop(idle);
            return;
        }
        idle.sets += 1;
        idle.bytes += bytes;
        match idle
            .shelves
            .iter_mut()
            .find_map(|shelf| shelf.downcast_mut::<Vec<B>>())
        {
            Some(shelf) => shelf.push(set),
            None => idle.shelves.push(Box::new(vec![set])),
        }
    }
}

/// Frees the scratch memory that finished renders have left for the next ones.
///
/// It is at most 512 MiB; the next render allocates anew what it needs.
pub fn release_memory() {
    let mut idle = idle();
    let shelves = std::mem::take(&mut idle.shelves);
    (idle.sets, idle.bytes) = (0, 0);
    drop(idle);
    drop(shelves);
}

/// Bytes set aside by a vector.
pub(crate) fn bytes_of<U>(buffer: &Vec<U>) -> usize {
    buffer.capacity() * size_of::<U>()
}

/// A buffer of `len` elements whose old contents may still be there: for one that is overwritten whole.
pub(crate) fn stale<U: Copy + Default>(buffer: &mut Vec<U>, len: usize) -> &mut [U] {
    if buffer.capacity() < len {
        // Cleared first, so that growing copies nothing. Within the capacity only what is new is written: the counts of
        // a fit rise a little with every call.
        buffer.clear();
    }
    buffer.resize(len, U::default());
    buffer
}

/// A buffer of `len` elements, all of them `value`.
pub(crate) fn filled<U: Copy>(buffer: &mut Vec<U>, len: usize, value: U) -> &mut [U] {
    buffer.clear();
    buffer.resize(len, value);
    buffer
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Default)]
    struct Numbers(Vec<u64>);

    impl Buffers for Numbers {
        fn bytes(&self) -> usize {
            bytes_of(&self.0)
        }
    }

    #[test]
    fn buffers_come_back() {
        let mut first = Pooled::<Numbers>::take();
        let buffer = &mut first.deref_mut().0;
        filled(buffer, 1000, 7);
        let place = buffer.as_ptr();
        drop(first);
        let mut again = Pooled::<Numbers>::take();
        let buffer = &mut again.deref_mut().0;
        assert_eq!(buffer.as_ptr(), place);
        assert_eq!(filled(buffer, 500, 1), [1; 500]);
        assert!(Pooled::<Numbers>::take().deref().0.is_empty());
    }

    #[test]
    fn what_is_too_large_is_not_kept() {
        let mut huge = Pooled::<Numbers>::take();
        huge.deref_mut().0 = Vec::with_capacity(IDLE_BYTES / size_of::<u64>() + 1);
        drop(huge);
        assert!(idle().bytes <= IDLE_BYTES);
    }
}
