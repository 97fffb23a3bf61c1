//! Pinhole and orthographic cameras.

use crate::error::RasterError;
use crate::math::covariance::{cross, dot, three};
use crate::math::real::Real;

/// Pixels along a side at most: further out `f32` no longer resolves the hundredth of a pixel that culling allows for.
const MAX_SIDE: usize = 1 << 16;
/// Pixels at most: what sizes are multiplied by later stays far from the end of the integers.
const MAX_PIXELS: usize = 1 << 28;

/// How a camera maps a point (X, Y, Z) of its own frame to the image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum CameraModel {
    /// x = fx X / Z + cx: distant things are small.
    #[default]
    Pinhole,
    /// x = fx X + cx: size does not depend on distance. Z still orders, and still has a near and a far plane.
    Orthographic,
}

impl CameraModel {
    /// The model gsplat calls `pinhole` or `ortho`.
    pub fn from_name(name: &str) -> Option<Self> {
        match name {
            "pinhole" => Some(Self::Pinhole),
            "ortho" => Some(Self::Orthographic),
            _ => None,
        }
    }
}

/// Focal lengths and principal point, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics<T> {
    /// Focal length along x; of an orthographic camera, pixels per unit of length.
    pub fx: T,
    /// The same along y.
    pub fy: T,
    /// Principal point, x.
    pub cx: T,
    /// Principal point, y.
    pub cy: T,
}

impl<T: Real> Intrinsics<T> {
    /// Those of a camera with square pixels, its principal point in the middle, and this angle, in radians, from the upper
    /// to the lower edge.
    #[must_use]
    pub fn from_fov_y(angle: T, width: usize, height: usize) -> Self {
        let focal = T::of(0.5 * height as f64 / (0.5 * angle.as_f64()).tan());
        Self {
            fx: focal,
            fy: focal,
            cx: T::of(0.5 * width as f64),
            cy: T::of(0.5 * height as f64),
        }
    }
}

/// A camera with OpenCV axes (x right, y down, z forward); the centre of pixel (column i, row j) is
/// (i + ½, j + ½).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera<T> {
    /// Rotation part of the world-to-camera matrix, row by row.
    pub(crate) rotation: [[T; 3]; 3],
    pub(crate) translation: [T; 3],
    pub(crate) k: Intrinsics<T>,
    pub(crate) model: CameraModel,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl<T: Real> Camera<T> {
    /// A pinhole camera from its row-major world-to-camera matrix. The 3×3 part need not be orthonormal.
    ///
    /// # Errors
    /// A matrix that is not finite, is singular or whose last row is not 0 0 0 1, a focal length that is not
    /// positive, an empty image, or one of more than 65,536 pixels a side or 2^28 in all.
    pub fn new(
        viewmat: [[T; 4]; 4],
        k: Intrinsics<T>,
        width: usize,
        height: usize,
    ) -> Result<Self, RasterError> {
        let bad = |reason| Err(RasterError::BadCamera { reason });
        if let Some(index) = viewmat.iter().flatten().position(|v| !v.is_finite()) {
            return Err(RasterError::NotFinite {
                name: "viewmats",
                index,
            });
        }
        if let Some(index) = [k.fx, k.fy, k.cx, k.cy].iter().position(|v| !v.is_finite()) {
            return Err(RasterError::NotFinite { name: "Ks", index });
        }
        if viewmat[3] != [T::ZERO, T::ZERO, T::ZERO, T::ONE] {
            return bad("expected 0 0 0 1 as the last row of the world-to-camera matrix");
        }
        let rotation = [0, 1, 2].map(|i| [viewmat[i][0], viewmat[i][1], viewmat[i][2]]);
        // Relative to the lengths of the rows, so that a scaled world does not look singular; measured in units of each
        // row's largest entry, so that no product leaves the range of numbers.
        let rows = rotation.map(|r| {
            let largest = r.iter().fold(T::TINY, |largest, v| largest.greater(v.abs()));
            r.map(|v| (v / largest).as_f64())
        });
        let volume = rows[0][0] * (rows[1][1] * rows[2][2] - rows[1][2] * rows[2][1])
            - rows[0][1] * (rows[1][0] * rows[2][2] - rows[1][2] * rows[2][0])
            + rows[0][2] * (rows[1][0] * rows[2][1] - rows[1][1] * rows[2][0]);
        let lengths: f64 = rows
            .iter()
            .map(|r| r.iter().map(|v| v * v).sum::<f64>().sqrt())
            .product();
        if !(volume.abs() > 1e-9 * lengths) {
            return bad("expected an invertible world-to-camera matrix, found a singular one");
        }
        if !(k.fx > T::ZERO && k.fy > T::ZERO) {
            return bad("expected positive focal lengths");
        }
        check_size(width, height)?;
        Ok(Self {
            rotation,
            translation: [viewmat[0][3], viewmat[1][3], viewmat[2][3]],
            k,
            model: CameraModel::Pinhole,
            width,
            height,
        })
    }

    /// The same camera with another way to project.
    #[must_use]
    pub fn with_model(self, model: CameraModel) -> Self {
        Self { model, ..self }
    }

    /// The row-major world-to-camera matrix.
    pub fn viewmat(&self) -> [[T; 4]; 4] {
        let row = |i: usize| {
            let [a, b, c] = self.rotation[i];
            [a, b, c, self.translation[i]]
        };
        [row(0), row(1), row(2), [T::ZERO, T::ZERO, T::ZERO, T::ONE]]
    }

    /// Focal lengths and principal point.
    pub fn intrinsics(&self) -> Intrinsics<T> {
        self.k
    }

    /// How it projects.
    pub fn model(&self) -> CameraModel {
        self.model
    }

    /// The columns of the inverse of the 3×3 part of the world-to-camera matrix.
    pub(crate) fn inverse_columns(&self) -> [[f64; 3]; 3] {
        let [r0, r1, r2] = self.rotation.map(|row| row.map(T::as_f64));
        let volume = dot(r0, cross(r1, r2));
        [cross(r1, r2), cross(r2, r0), cross(r0, r1)].map(|column| column.map(|v| v / volume))
    }

    /// Where the camera is, in the world.
    pub(crate) fn centre(&self) -> [T; 3] {
        let [x, y, z] = self.inverse_columns();
        let t = self.translation.map(T::as_f64);
        three(|i| T::of(-(x[i] * t[0] + y[i] * t[1] + z[i] * t[2])))
    }

    /// Image width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Image height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }
}

/// Whether an image may have these sides.
pub(crate) fn check_size(width: usize, height: usize) -> Result<(), RasterError> {
    let bad = |reason| Err(RasterError::BadCamera { reason });
    if width == 0 || height == 0 {
        return bad("expected an image of at least one pixel");
    }
    if width > MAX_SIDE || height > MAX_SIDE || width * height > MAX_PIXELS {
        return bad("expected an image of at most 65536 pixels a side and 2^28 in all");
    }
    Ok(())
}
