//! The only place that touches numpy arrays: borrowed views in, owned vectors out, neither copied.

use bigs_raster::{BatchInputs, BatchShape, CameraModel, Scalar, Slabs};
use numpy::{
    Element, IntoPyArray, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// A borrowed array of this scalar, in C's order; `TypeError` for another dtype, `ValueError` for another order.
pub(crate) fn slice<'py, T: Element>(
    name: &str,
    array: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArrayDyn<'py, T>> {
    let array = array
        .cast::<PyArrayDyn<T>>()
        .map_err(|_| PyTypeError::new_err(format!("{name}: expected one floating dtype for all arrays")))?;
    // A slice can be had of Fortran's order, too: the same values at other places.
    if !array.is_c_contiguous() {
        return Err(PyValueError::new_err(format!(
            "{name}: expected a C-contiguous array"
        )));
    }
    Ok(array.readonly())
}

/// How many slabs an array holds: entries, cameras.
pub(crate) type Count = (usize, usize);

/// The arrays of a call, borrowed for as long as this lives.
pub(crate) struct Arrays<'py, T: Element> {
    counts: [Count; NAMES.len() + 2],
    floats: Vec<PyReadonlyArrayDyn<'py, T>>,
    backgrounds: Option<PyReadonlyArrayDyn<'py, T>>,
    pixel_mask: Option<PyReadonlyArrayDyn<'py, bool>>,
}

const NAMES: [&str; 7] = [
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "viewmats",
    "Ks",
];

impl<'py, T: Scalar + Element> Arrays<'py, T> {
    /// Reads (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds | None, pixel_mask | None).
    pub(crate) fn extract(arrays: &Bound<'py, PyTuple>, counts: [Count; NAMES.len() + 2]) -> PyResult<Self> {
        if arrays.len() != NAMES.len() + 2 {
            return Err(PyTypeError::new_err("arrays: expected nine entries"));
        }
        let optional = |index: usize| {
            arrays
                .get_item(index)
                .map(|item| (!item.is_none()).then_some(item))
        };
        Ok(Self {
            counts,
            floats: NAMES
                .iter()
                .enumerate()
                .map(|(index, name)| slice(name, &arrays.get_item(index)?))
                .collect::<PyResult<_>>()?,
            backgrounds: optional(7)?.map(|item| slice("backgrounds", &item)).transpose()?,
            pixel_mask: optional(8)?.map(|item| slice("pixel_mask", &item)).transpose()?,
        })
    }

    /// The same as borrowed slabs, and the sizes they imply.
    pub(crate) fn inputs(
        &self,
        (width, height): (usize, usize),
        camera_model: CameraModel,
    ) -> PyResult<(BatchShape, BatchInputs<'_, T>)> {
        let slabs = |index: usize| slabs(NAMES[index], &self.floats[index], self.counts[index]);
        let backgrounds = self.backgrounds.as_ref();
        let pixel_mask = self.pixel_mask.as_ref();
        let inputs = BatchInputs {
            means: slabs(0)?,
            quats: slabs(1)?,
            scales: slabs(2)?,
            opacities: slabs(3)?,
            colors: slabs(4)?,
            viewmats: slabs(5)?,
            ks: slabs(6)?,
            camera_model,
            backgrounds: backgrounds
                .map(|a| self::slabs("backgrounds", a, self.counts[7]))
                .transpose()?,
            pixel_mask: pixel_mask
                .map(|a| self::slabs("pixel_mask", a, self.counts[8]))
                .transpose()?,
        };
        let last = |index: usize, from_end: usize| {
            let shape = self.floats[index].shape();
            shape.len().checked_sub(from_end).map_or(0, |axis| shape[axis])
        };
        let shape = BatchShape {
            entries: self.counts.iter().fold(1, |size, count| wider(size, count.0)),
            cameras: self.counts.iter().fold(1, |size, count| wider(size, count.1)),
            gaussians: last(0, 2),
            channels: last(4, 1),
            width,
            height,
        };
        Ok((shape, inputs))
    }
}

/// The size two broadcast sizes have together; a size of 0 stays 0.
fn wider(a: usize, b: usize) -> usize {
    if a == 1 { b } else { a }
}

fn slabs<'a, U: Element>(
    name: &str,
    array: &'a PyReadonlyArrayDyn<'_, U>,
    (entries, cameras): Count,
) -> PyResult<Slabs<'a, U>> {
    let data = array
        .as_slice()
        .map_err(|_| PyValueError::new_err(format!("{name}: expected a C-contiguous array")))?;
    Ok(Slabs {
        data,
        entries,
        cameras,
    })
}

/// Hands a vector over to numpy, in the shape `lead` + `own`.
pub(crate) fn array<'py, U: Element>(
    py: Python<'py>,
    values: Vec<U>,
    lead: &[usize],
    own: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    let shape: Vec<usize> = lead.iter().chain(own).copied().collect();
    Ok(values.into_pyarray(py).reshape(shape)?.into_any())
}

/// Hands a flat gradient over to numpy.
pub(crate) fn gradient<U: Element>(py: Python<'_>, values: Vec<U>) -> Bound<'_, PyArray1<U>> {
    values.into_pyarray(py)
}
