//! Terms of rendered pictures: the Python face of `bigs_ops::pixels`.

use bigs_ops::pixels::{Frames, alone, together};
use numpy::{Element, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::Kind;
use crate::convert::{contiguous, gradient, is_single, slice};
use crate::run;

/// Arrays of a call by position, borrowed for as long as this lives; where one may be None, so may be its entry.
struct Held<'py, T: Element>(Vec<Option<PyReadonlyArrayDyn<'py, T>>>);

impl<'py, T: Kind> Held<'py, T> {
    fn extract(names: &[&str], arrays: &Bound<'py, PyTuple>) -> PyResult<Self> {
        if arrays.len() < names.len() {
            return Err(PyTypeError::new_err(format!(
                "arrays: expected {}",
                names.join(", ")
            )));
        }
        let last = names.last().copied().unwrap_or("arrays");
        let held = arrays.iter().enumerate().map(|(at, array)| {
            let name = names.get(at).copied().unwrap_or(last);
            (!array.is_none()).then(|| slice(name, &array)).transpose()
        });
        Ok(Self(held.collect::<PyResult<_>>()?))
    }

    fn maybe(&self, at: usize) -> PyResult<Option<&[T]>> {
        self.0[at]
            .as_ref()
            .map(|array| contiguous("arrays", array))
            .transpose()
    }

    fn get(&self, at: usize) -> PyResult<&[T]> {
        self.maybe(at)?
            .ok_or_else(|| PyTypeError::new_err("arrays: expected an array, found None"))
    }

    fn shape(&self, at: usize) -> &[usize] {
        self.0[at].as_ref().map_or(&[], |array| array.shape())
    }

    /// The frames of a step, of a clip whose masks are the array at `at`, `[T, H, W]`.
    fn frames<'a>(&self, frames: &'a [usize], at: usize) -> Frames<'a> {
        let shape = self.shape(at);
        Frames {
            frames,
            pixels: shape.iter().skip(1).product(),
            clip: shape.first().copied().unwrap_or(0),
        }
    }
}

const TOGETHER: [&str; 6] = ["colors", "alphas", "images", "foreground", "unknown", "shares"];

fn all_together<'a, T: Kind>(
    held: &'a Held<'_, T>,
    frames: &'a [usize],
    covered: f64,
) -> PyResult<together::Together<'a, T>> {
    Ok(together::Together {
        frames: held.frames(frames, 3),
        colors: held.get(0)?,
        channels: held.shape(0).last().copied().unwrap_or(0),
        alphas: held.get(1)?,
        images: held.get(2)?,
        foreground: held.get(3)?,
        unknown: held.get(4)?,
        shares: (5..held.0.len())
            .map(|at| held.get(at))
            .collect::<PyResult<_>>()?,
        covered,
    })
}

/// Four terms of pictures of all subjects together, and the areas that they are means over: see `bigs.fused.pixels`.
///
/// `arrays` is (colors `[B, H, W, D]`, alphas `[B, H, W, 1]`, images `[T, H, W, 3]`, foreground, unknown and for each label
/// a share `[T, H, W]`), C-contiguous, float32 or float64 throughout; `frames` names B of the T. Raises ValueError.
#[pyfunction]
pub(crate) fn terms_together(
    py: Python<'_>,
    arrays: &Bound<'_, PyTuple>,
    frames: Vec<usize>,
    covered: f64,
) -> PyResult<([f64; 4], [f64; 2])> {
    fn of<T: Kind>(
        py: Python<'_>,
        arrays: &Bound<'_, PyTuple>,
        frames: &[usize],
        covered: f64,
    ) -> PyResult<([f64; 4], [f64; 2])> {
        let held = Held::<T>::extract(&TOGETHER[..5], arrays)?;
        let pictures = all_together(&held, frames, covered)?;
        let terms = run(py, || pictures.terms())?;
        Ok((terms.values, [terms.foreground, terms.labelled]))
    }
    if is_single(arrays) {
        of::<f32>(py, arrays, &frames, covered)
    } else {
        of::<f64>(py, arrays, &frames, covered)
    }
}

/// Flat gradients of colors and alphas from those of the four terms. Takes the arguments and the areas of the forward call.
#[pyfunction]
pub(crate) fn terms_together_backward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    frames: Vec<usize>,
    covered: f64,
    areas: [f64; 2],
    v: [f64; 4],
) -> PyResult<Bound<'py, PyTuple>> {
    fn of<'py, T: Kind>(
        py: Python<'py>,
        arrays: &Bound<'py, PyTuple>,
        (frames, covered): (&[usize], f64),
        terms: &together::Terms,
        v: [f64; 4],
    ) -> PyResult<Bound<'py, PyTuple>> {
        let held = Held::<T>::extract(&TOGETHER[..5], arrays)?;
        let pictures = all_together(&held, frames, covered)?;
        let (colors, alphas) = run(py, || pictures.vjp(terms, v))?;
        (gradient(py, colors), gradient(py, alphas)).into_pyobject(py)
    }
    let terms = together::Terms {
        values: [0.0; 4],
        foreground: areas[0],
        labelled: areas[1],
    };
    if is_single(arrays) {
        of::<f32>(py, arrays, (&frames, covered), &terms, v)
    } else {
        of::<f64>(py, arrays, (&frames, covered), &terms, v)
    }
}

const OUTLINE: [&str; 3] = ["alphas", "own", "hidden"];

fn outline<'a, T: Kind>(held: &'a Held<'_, T>, frames: &'a [usize]) -> PyResult<alone::Outline<'a, T>> {
    Ok(alone::Outline {
        frames: held.frames(frames, 1),
        alphas: held.get(0)?,
        own: held.get(1)?,
        hidden: held.get(2)?,
    })
}

/// The squared distance `[B]` of each picture's coverage from what masks allow, summed over its pixels: see
/// `bigs.fused.pixels`.
///
/// `arrays` is (alphas `[B, H, W]`, own and hidden `[T, H, W]`), C-contiguous, float32 or float64 throughout; `frames` names B
/// of the T. Raises ValueError.
#[pyfunction]
pub(crate) fn coverage_squares(
    py: Python<'_>,
    arrays: &Bound<'_, PyTuple>,
    frames: Vec<usize>,
) -> PyResult<Vec<f64>> {
    fn of<T: Kind>(py: Python<'_>, arrays: &Bound<'_, PyTuple>, frames: &[usize]) -> PyResult<Vec<f64>> {
        let held = Held::<T>::extract(&OUTLINE, arrays)?;
        let outline = outline(&held, frames)?;
        run(py, || outline.squares())
    }
    if is_single(arrays) {
        of::<f32>(py, arrays, &frames)
    } else {
        of::<f64>(py, arrays, &frames)
    }
}

/// The flat gradient of alphas from that of the pictures' sums. Takes the arguments of the forward call.
#[pyfunction]
pub(crate) fn coverage_squares_backward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    frames: Vec<usize>,
    v: Vec<f64>,
) -> PyResult<Bound<'py, PyAny>> {
    fn of<'py, T: Kind>(
        py: Python<'py>,
        arrays: &Bound<'py, PyTuple>,
        frames: &[usize],
        v: &[f64],
    ) -> PyResult<Bound<'py, PyAny>> {
        let held = Held::<T>::extract(&OUTLINE, arrays)?;
        let outline = outline(&held, frames)?;
        let pulls = run(py, || outline.squares_vjp(v))?;
        Ok(gradient(py, pulls).into_any())
    }
    if is_single(arrays) {
        of::<f32>(py, arrays, &frames, &v)
    } else {
        of::<f64>(py, arrays, &frames, &v)
    }
}

const ALONE: [&str; 5] = ["alphas", "colors", "images", "own", "hidden"];

fn one_alone<'a, T: Kind>(held: &'a Held<'_, T>, frames: &'a [usize]) -> PyResult<alone::Alone<'a, T>> {
    Ok(alone::Alone {
        outline: alone::Outline {
            frames: held.frames(frames, 3),
            alphas: held.get(0)?,
            own: held.get(3)?,
            hidden: held.get(4)?,
        },
        colors: held.maybe(1)?,
        images: held.get(2)?,
    })
}

/// Three terms of pictures of one subject alone, and the area that they are means over: see `bigs.fused.pixels`.
///
/// `arrays` is (alphas `[B, H, W, 1]`, colors `[B, H, W, 3]` or None, images `[T, H, W, 3]`, own and hidden `[T, H, W]`),
/// C-contiguous, float32 or float64 throughout; `frames` names B of the T. Raises ValueError.
#[pyfunction]
pub(crate) fn terms_alone(
    py: Python<'_>,
    arrays: &Bound<'_, PyTuple>,
    frames: Vec<usize>,
) -> PyResult<([f64; 3], f64)> {
    fn of<T: Kind>(
        py: Python<'_>,
        arrays: &Bound<'_, PyTuple>,
        frames: &[usize],
    ) -> PyResult<([f64; 3], f64)> {
        let held = Held::<T>::extract(&ALONE, arrays)?;
        let pictures = one_alone(&held, frames)?;
        let terms = run(py, || pictures.terms())?;
        Ok((terms.values, terms.own))
    }
    if is_single(arrays) {
        of::<f32>(py, arrays, &frames)
    } else {
        of::<f64>(py, arrays, &frames)
    }
}

/// Flat gradients of colors, empty without them, and of alphas from those of the three terms. Takes the arguments and the
/// area of the forward call.
#[pyfunction]
pub(crate) fn terms_alone_backward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    frames: Vec<usize>,
    area: f64,
    v: [f64; 3],
) -> PyResult<Bound<'py, PyTuple>> {
    fn of<'py, T: Kind>(
        py: Python<'py>,
        arrays: &Bound<'py, PyTuple>,
        frames: &[usize],
        terms: &alone::Terms,
        v: [f64; 3],
    ) -> PyResult<Bound<'py, PyTuple>> {
        let held = Held::<T>::extract(&ALONE, arrays)?;
        let pictures = one_alone(&held, frames)?;
        let (colors, alphas) = run(py, || pictures.vjp(terms, v))?;
        (gradient(py, colors), gradient(py, alphas)).into_pyobject(py)
    }
    let terms = alone::Terms {
        values: [0.0; 3],
        own: area,
    };
    if is_single(arrays) {
        of::<f32>(py, arrays, &frames, &terms, v)
    } else {
        of::<f64>(py, arrays, &frames, &terms, v)
    }
}
