//! Arrays that a caller gets.

use rayon::prelude::*;

use crate::error::RasterError;

/// Bytes from which memory is asked for before it is used: less is taken for granted.
const LARGE: usize = 1 << 24;

/// Bytes that one thread fills at least, where there are several.
const FILLED_AT_ONCE: usize = 1 << 16;

/// The product of sizes, or the largest number there is.
pub(crate) fn product(sizes: &[usize]) -> usize {
    sizes
        .iter()
        .fold(1, |product, &size| product.saturating_mul(size))
}

/// An array of as many values as the product of `sizes`; a large one is filled by all threads.
///
/// # Errors
/// [`RasterError::OutOfMemory`].
pub fn filled_with<U: Copy + Send + Sync>(
    name: &'static str,
    value: U,
    sizes: &[usize],
) -> Result<Vec<U>, RasterError> {
    let elements = product(sizes);
    let bytes = elements.saturating_mul(size_of::<U>());
    // Asked for and given back at once: `vec!` gets zeros from the system for nothing, but ends the process where there
    // are none.
    if bytes >= LARGE && Vec::<U>::new().try_reserve_exact(elements).is_err() {
        return Err(RasterError::OutOfMemory { name, elements });
    }
    if bytes >= 4 * FILLED_AT_ONCE && rayon::current_num_threads() > 1 {
        let mut values = Vec::new();
        let each = FILLED_AT_ONCE / size_of::<U>().max(1);
        rayon::iter::repeat_n(value, elements)
            .with_min_len(each)
            .collect_into_vec(&mut values);
        return Ok(values);
    }
    Ok(vec![value; elements])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_beyond_numbers_and_memory_are_errors() {
        assert_eq!(filled_with("a", 0u8, &[3, 5]).map(|a| a.len()), Ok(15));
        assert_eq!(filled_with("a", 0u8, &[0, usize::MAX, 2]).map(|a| a.len()), Ok(0));
        for sizes in [[usize::MAX, 2], [1 << 62, 1]] {
            let refused = filled_with("a", 0.0f64, &sizes);
            assert!(matches!(refused, Err(RasterError::OutOfMemory { name: "a", .. })));
        }
    }
}
