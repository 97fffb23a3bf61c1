//! The second stage: which splats each tile shows, front to back.

mod depth_order;
mod merge_runs;
pub(crate) mod radix_sort;
pub(crate) mod tile_lists;
