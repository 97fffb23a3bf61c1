//! The only place that touches numpy arrays: borrowed views in, owned vectors out, neither copied but for masks.

use bigs_raster::{BatchGaussians, BatchInputs, BatchShape, Broadcast, CameraModel, Scalar};
use numpy::{
    Element, IntoPyArray, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArray,
    PyUntypedArrayMethods, dtype,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// A borrowed array of this scalar, which is that of the first array of a call; `TypeError` for another one.
pub(crate) fn slice<'py, T: Element>(
    name: &str,
    array: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArrayDyn<'py, T>> {
    let array = array.cast::<PyArrayDyn<T>>().map_err(|_| {
        let found = array.cast::<PyUntypedArray>().map_or_else(
            |_| {
                array
                    .get_type()
                    .name()
                    .map_or_else(|_| "another type".into(), |name| name.to_string())
            },
            |array| array.dtype().to_string(),
        );
        let expected = dtype::<T>(array.py());
        PyTypeError::new_err(format!("{name}: expected an array of {expected}, found {found}"))
    })?;
    Ok(array.readonly())
}

/// Whether the first of some arrays, whose dtype all must have, is float32.
pub(crate) fn is_single(arrays: &Bound<'_, PyTuple>) -> bool {
    arrays
        .get_item(0)
        .is_ok_and(|array| array.cast::<PyArrayDyn<f32>>().is_ok())
}

/// How many parts an array holds: entries, cameras.
pub(crate) type Count = (usize, usize);

/// The values of an array in the order of its axes.
pub(crate) fn contiguous<'a, U: Element>(
    name: &str,
    array: &'a PyReadonlyArrayDyn<'_, U>,
) -> PyResult<&'a [U]> {
    // `as_slice` alone takes Fortran's order, too: the same values at other places.
    match array.as_slice() {
        Ok(values) if array.is_c_contiguous() => Ok(values),
        _ if array.is_c_contiguous() => Err(PyValueError::new_err(format!(
            "{name}: expected an array aligned to its values, found one in between"
        ))),
        _ => Err(PyValueError::new_err(format!(
            "{name}: expected a C-contiguous array"
        ))),
    }
}

/// The values of an array of bool. Copied: numpy takes every byte but 0 for true, Rust no other than 1.
pub(crate) fn mask(name: &str, array: &Bound<'_, PyAny>) -> PyResult<Vec<bool>> {
    contiguous(name, &slice::<bool>(name, array)?)?;
    let bytes: PyReadonlyArrayDyn<'_, u8> = slice(name, &array.call_method1("view", ("uint8",))?)?;
    Ok(contiguous(name, &bytes)?.iter().map(|&byte| byte != 0).collect())
}

/// The values of an array whose last axis has D of them, in rows.
pub(crate) fn rows<'a, U: Element, const D: usize>(
    name: &str,
    array: &'a PyReadonlyArrayDyn<'_, U>,
) -> PyResult<&'a [[U; D]]> {
    if array.shape().last() != Some(&D) {
        return Err(PyValueError::new_err(format!(
            "{name}: expected rows of {D} values, found shape {:?}",
            array.shape()
        )));
    }
    Ok(contiguous(name, array)?.as_chunks().0)
}

/// The arrays of Gaussians, borrowed for as long as this lives.
pub(crate) struct Gaussians<'py, T: Element> {
    counts: [Count; 5],
    arrays: Vec<PyReadonlyArrayDyn<'py, T>>,
}

/// Names of arrays, and how many values the last axis has where that is fixed.
const GAUSSIANS: [(&str, Option<usize>); 5] = [
    ("means", Some(3)),
    ("quats", Some(4)),
    ("scales", Some(3)),
    ("opacities", None),
    ("colors", None),
];

impl<'py, T: Scalar + Element> Gaussians<'py, T> {
    /// Reads (means, quats, scales, opacities, colors), the first entries of a tuple.
    pub(crate) fn extract(arrays: &Bound<'py, PyTuple>, counts: [Count; 5]) -> PyResult<Self> {
        if arrays.len() < GAUSSIANS.len() {
            return Err(PyTypeError::new_err(
                "arrays: expected means, quats, scales, opacities and colors",
            ));
        }
        let mut own = Vec::new();
        for (index, (name, last)) in GAUSSIANS.into_iter().enumerate() {
            let array: PyReadonlyArrayDyn<'py, T> = slice(name, &arrays.get_item(index)?)?;
            if let Some(size) = last.filter(|size| array.shape().last() != Some(size)) {
                return Err(PyValueError::new_err(format!(
                    "{name}: expected {size} values on the last axis, found shape {:?}",
                    array.shape()
                )));
            }
            own.push(array);
        }
        Ok(Self { counts, arrays: own })
    }

    pub(crate) fn broadcast(&self) -> PyResult<BatchGaussians<'_, T>> {
        let of = |index: usize| broadcast(GAUSSIANS[index].0, &self.arrays[index], self.counts[index]);
        Ok(BatchGaussians {
            means: of(0)?,
            quats: of(1)?,
            scales: of(2)?,
            opacities: of(3)?,
            colors: of(4)?,
        })
    }

    /// The size of an axis, counted from the end; 0 where there is none.
    fn axis(&self, index: usize, from_end: usize) -> usize {
        let shape = self.arrays[index].shape();
        shape.len().checked_sub(from_end).map_or(0, |axis| shape[axis])
    }
}

/// The arrays of a call, borrowed for as long as this lives.
pub(crate) struct Arrays<'py, T: Element> {
    counts: [Count; 9],
    gaussians: Gaussians<'py, T>,
    viewmats: PyReadonlyArrayDyn<'py, T>,
    ks: PyReadonlyArrayDyn<'py, T>,
    backgrounds: Option<PyReadonlyArrayDyn<'py, T>>,
    pixel_mask: Option<Vec<bool>>,
}

impl<'py, T: Scalar + Element> Arrays<'py, T> {
    /// Reads (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds | None, pixel_mask | None).
    pub(crate) fn extract(arrays: &Bound<'py, PyTuple>, counts: [Count; 9]) -> PyResult<Self> {
        if arrays.len() != counts.len() {
            return Err(PyTypeError::new_err("arrays: expected nine entries"));
        }
        let optional = |index: usize| {
            arrays
                .get_item(index)
                .map(|item| (!item.is_none()).then_some(item))
        };
        let [means, quats, scales, opacities, colors, ..] = counts;
        Ok(Self {
            counts,
            gaussians: Gaussians::extract(arrays, [means, quats, scales, opacities, colors])?,
            viewmats: slice("viewmats", &arrays.get_item(5)?)?,
            ks: slice("Ks", &arrays.get_item(6)?)?,
            backgrounds: optional(7)?.map(|item| slice("backgrounds", &item)).transpose()?,
            pixel_mask: optional(8)?.map(|item| mask("pixel_mask", &item)).transpose()?,
        })
    }

    /// The same, borrowed, and the sizes they imply.
    pub(crate) fn inputs(
        &self,
        (width, height): (usize, usize),
        camera_model: CameraModel,
    ) -> PyResult<(BatchShape, BatchInputs<'_, T>)> {
        let backgrounds = self.backgrounds.as_ref();
        let inputs = BatchInputs {
            gaussians: self.gaussians.broadcast()?,
            viewmats: broadcast("viewmats", &self.viewmats, self.counts[5])?,
            ks: broadcast("Ks", &self.ks, self.counts[6])?,
            camera_model,
            backgrounds: backgrounds
                .map(|a| broadcast("backgrounds", a, self.counts[7]))
                .transpose()?,
            pixel_mask: self.pixel_mask.as_deref().map(|data| Broadcast {
                data,
                entries: self.counts[8].0,
                cameras: self.counts[8].1,
            }),
        };
        let shape = BatchShape {
            entries: self.counts.iter().fold(1, |size, count| wider(size, count.0)),
            cameras: self.counts.iter().fold(1, |size, count| wider(size, count.1)),
            gaussians: self.gaussians.axis(0, 2),
            channels: self.gaussians.axis(4, 1),
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

fn broadcast<'a, U: Element>(
    name: &str,
    array: &'a PyReadonlyArrayDyn<'_, U>,
    (entries, cameras): Count,
) -> PyResult<Broadcast<'a, U>> {
    Ok(Broadcast {
        data: contiguous(name, array)?,
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
    // Checked here: numpy takes the largest size for "whatever fits".
    if shape
        .iter()
        .fold(1usize, |product, &size| product.saturating_mul(size))
        != values.len()
    {
        return Err(PyValueError::new_err(format!(
            "lead: expected axes for {} values, found shape {shape:?}",
            values.len()
        )));
    }
    Ok(values.into_pyarray(py).reshape(shape)?.into_any())
}

/// Hands a flat gradient over to numpy.
pub(crate) fn gradient<U: Element>(py: Python<'_>, values: Vec<U>) -> Bound<'_, PyArray1<U>> {
    values.into_pyarray(py)
}
