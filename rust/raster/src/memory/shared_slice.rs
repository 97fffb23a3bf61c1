//! Slices of integers that several threads write, each in places of its own.
#![allow(unsafe_code)]

use std::sync::atomic::{AtomicU32, Ordering};

/// A slice that is written through shared references. Where two threads write to one place, one of them wins.
pub(crate) struct Shared<'a>(&'a [AtomicU32]);

impl<'a> Shared<'a> {
    pub(crate) fn new(values: &'a mut [u32]) -> Self {
        const { assert!(align_of::<AtomicU32>() == align_of::<u32>()) };
        let atomics = std::ptr::from_mut(values) as *const [AtomicU32];
        // SAFETY: an atomic integer has the size and bits of the integer, and as just asserted its alignment; nothing
        // else can reach the slice while it is borrowed.
        Self(unsafe { &*atomics })
    }

    #[inline(always)]
    pub(crate) fn set(&self, index: usize, value: u32) {
        self.0[index].store(value, Ordering::Relaxed);
    }
}
