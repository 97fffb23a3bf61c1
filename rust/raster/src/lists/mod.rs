//! The second stage: which splats each tile shows, front to back.

pub(crate) mod radix_sort;
pub(crate) mod tile_lists;
