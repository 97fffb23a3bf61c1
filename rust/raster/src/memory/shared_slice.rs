//! Slices that several threads write, each in places of its own.
#![allow(unsafe_code)]

use std::marker::PhantomData;
use std::sync::atomic::{AtomicU32, Ordering};

/// A slice of pairs of integers that is written through shared references. Where two threads write to one place, one of
/// them wins, number by number.
pub(crate) struct Shared<'a>(&'a [[AtomicU32; 2]]);

impl<'a> Shared<'a> {
    pub(crate) fn new(values: &'a mut [[u32; 2]]) -> Self {
        const { assert!(align_of::<AtomicU32>() == align_of::<u32>()) };
        let atomics = std::ptr::from_mut(values) as *const [[AtomicU32; 2]];
        // SAFETY: an atomic integer has the size and bits of the integer, and as just asserted its alignment; nothing
        // else can reach the slice while it is borrowed.
        Self(unsafe { &*atomics })
    }

    #[inline(always)]
    pub(crate) fn set(&self, index: usize, [a, b]: [u32; 2]) {
        let place = &self.0[index];
        place[0].store(a, Ordering::Relaxed);
        place[1].store(b, Ordering::Relaxed);
    }
}

/// A slice of numbered pieces that threads write in any order, each piece by one thread. Atomic numbers would need no such
/// promise, but are written one by one: that took 12 to 20 per cent of the time of a backward pass through the tiles.
pub(crate) struct Scattered<'a, U> {
    first: *mut U,
    len: usize,
    borrowed: PhantomData<&'a mut [U]>,
}

// SAFETY: it only hands out pieces that, as `pieces` demands, no two threads have at once: as safe as to send each of them
// to its thread.
unsafe impl<U: Send> Sync for Scattered<'_, U> {}

impl<'a, U> Scattered<'a, U> {
    pub(crate) fn new(values: &'a mut [U]) -> Self {
        Self {
            first: values.as_mut_ptr(),
            len: values.len(),
            borrowed: PhantomData,
        }
    }

    /// Pieces of `size` values, for one thread to write some of.
    ///
    /// # Safety
    /// While the result lives, nothing made by another call has a piece with a number that this one is asked for.
    pub(crate) unsafe fn pieces(&self, size: usize) -> OwnPieces<'_, U> {
        OwnPieces { all: self, size }
    }

    /// All pieces of `size` values, for the only one who knows of them.
    #[cfg(test)]
    pub(crate) fn all_pieces(&mut self, size: usize) -> OwnPieces<'_, U> {
        OwnPieces { all: self, size }
    }
}

/// Some pieces of a [`Scattered`] slice.
pub(crate) struct OwnPieces<'a, U> {
    all: &'a Scattered<'a, U>,
    size: usize,
}

impl<U> OwnPieces<'_, U> {
    /// Values of a piece.
    pub(crate) fn size(&self) -> usize {
        self.size
    }

    /// # Panics
    /// Beyond the end of the slice.
    #[inline(always)]
    pub(crate) fn at(&mut self, number: u32) -> &mut [U] {
        let first = number as usize * self.size;
        assert!(first + self.size <= self.all.len, "a piece beyond the end");
        // SAFETY: within the slice, which is borrowed for longer than this; nobody else has this piece, as promised when
        // `self` was made, and `self` is borrowed as long as the result is.
        unsafe { std::slice::from_raw_parts_mut(self.all.first.add(first), self.size) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_threads_write_arrives() {
        let mut pairs = [[0u32; 2]; 6];
        let mut values = [0.0f64; 18];
        let (shared, scattered) = (Shared::new(&mut pairs), Scattered::new(&mut values));
        std::thread::scope(|scope| {
            for half in 0..2 {
                let (shared, scattered) = (&shared, &scattered);
                scope.spawn(move || {
                    // SAFETY: one thread takes the even numbers, the other the odd ones.
                    let mut pieces = unsafe { scattered.pieces(3) };
                    for i in (half..6).step_by(2) {
                        shared.set(i as usize, [i, 10 * i]);
                        pieces.at(i).fill(f64::from(i));
                    }
                });
            }
        });
        assert_eq!(pairs, [[0, 0], [1, 10], [2, 20], [3, 30], [4, 40], [5, 50]]);
        assert!(values.iter().enumerate().all(|(i, &v)| v == (i / 3) as f64));
    }

    #[test]
    #[should_panic(expected = "a piece beyond the end")]
    fn no_piece_lies_beyond_the_end() {
        let mut values = [0.0f32; 8];
        Scattered::new(&mut values).all_pieces(3).at(2);
    }
}
