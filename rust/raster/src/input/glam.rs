//! The types of glam at the border, and cameras from its matrices and vectors.
//!
//! Nothing behind the border uses them: the loops of the renderer run over arrays of one number each.

use crate::error::RasterError;
use crate::input::camera::{Camera, Intrinsics};
use crate::input::gaussians::check_finite;
use crate::math::covariance::{cross, dot, three};
use crate::math::real::Real;

/// The scalar's types in glam: `Vec3`, `Quat`, `Mat4` and `Affine3A` for `f32`, `DVec3`, `DQuat`, `DMat4` and `DAffine3`
/// for `f64`.
pub trait GlamTypes: Real {
    /// A point or a direction.
    type Vec3: Copy;
    /// A rotation, stored x y z w.
    type Quat: Copy;
    /// A matrix of four columns.
    type Mat4: Copy;
    /// Three columns and a translation.
    type Affine3: Copy;

    /// x, y, z.
    fn from_vec3(v: Self::Vec3) -> [Self; 3];
    /// The vector of x, y, z.
    fn to_vec3(v: [Self; 3]) -> Self::Vec3;
    /// w, x, y, z: this crate's order.
    fn from_quat(q: Self::Quat) -> [Self; 4];
    /// The quaternion of w, x, y, z.
    fn to_quat(q: [Self; 4]) -> Self::Quat;
    /// Rows.
    fn from_mat4(m: Self::Mat4) -> [[Self; 4]; 4];
    /// The matrix with these rows.
    fn to_mat4(rows: [[Self; 4]; 4]) -> Self::Mat4;
    /// The matrix of a transform.
    fn of_affine3(a: Self::Affine3) -> Self::Mat4;
    /// The transform of a matrix whose last row is 0 0 0 1.
    fn to_affine3(m: Self::Mat4) -> Self::Affine3;
}

macro_rules! glam_types {
    ($T:ty, $Vec3:ty, $Quat:ty, $Mat4:ty, $Affine3:ty) => {
        impl GlamTypes for $T {
            type Vec3 = $Vec3;
            type Quat = $Quat;
            type Mat4 = $Mat4;
            type Affine3 = $Affine3;

            fn from_vec3(v: $Vec3) -> [Self; 3] {
                v.to_array()
            }
            fn to_vec3(v: [Self; 3]) -> $Vec3 {
                <$Vec3>::from_array(v)
            }
            fn from_quat(q: $Quat) -> [Self; 4] {
                [q.w, q.x, q.y, q.z]
            }
            fn to_quat([w, x, y, z]: [Self; 4]) -> $Quat {
                <$Quat>::from_xyzw(x, y, z, w)
            }
            fn from_mat4(m: $Mat4) -> [[Self; 4]; 4] {
                m.transpose().to_cols_array_2d()
            }
            fn to_mat4(rows: [[Self; 4]; 4]) -> $Mat4 {
                <$Mat4>::from_cols_array_2d(&rows).transpose()
            }
            fn of_affine3(a: $Affine3) -> $Mat4 {
                a.into()
            }
            fn to_affine3(m: $Mat4) -> $Affine3 {
                <$Affine3>::from_mat4(m)
            }
        }
    };
}
glam_types!(f32, glam::Vec3, glam::Quat, glam::Mat4, glam::Affine3A);
glam_types!(f64, glam::DVec3, glam::DQuat, glam::DMat4, glam::DAffine3);

/// A vector of length 1; none for one without direction.
fn normalized<T: Real>(v: [T; 3]) -> Option<[T; 3]> {
    let largest = v[0].abs().greater(v[1].abs()).greater(v[2].abs());
    if !(largest >= T::TINY && largest.is_finite()) {
        return None;
    }
    let v = v.map(|x| x / largest);
    let length = dot(v, v).sqrt();
    Some(v.map(|x| x / length))
}

impl<T: GlamTypes> Camera<T> {
    /// [`Camera::new`] from a world-to-camera transform: what glam's `look_to_rh` and its kin make looks along −z with y
    /// up, which is turned by 180° about x against this crate's axes; [`Camera::look_at`] needs no turning.
    ///
    /// # Errors
    /// As [`Camera::new`].
    pub fn from_affine3(
        world_to_camera: T::Affine3,
        k: Intrinsics<T>,
        width: usize,
        height: usize,
    ) -> Result<Self, RasterError> {
        Self::from_mat4(T::of_affine3(world_to_camera), k, width, height)
    }

    /// [`Camera::new`] from a world-to-camera matrix.
    ///
    /// # Errors
    /// As [`Camera::new`].
    pub fn from_mat4(
        world_to_camera: T::Mat4,
        k: Intrinsics<T>,
        width: usize,
        height: usize,
    ) -> Result<Self, RasterError> {
        Self::new(T::from_mat4(world_to_camera), k, width, height)
    }

    /// A camera at `eye` that has `target` in its middle and `up` upwards.
    ///
    /// # Errors
    /// A vector that is not finite, a target at the eye or so far off that numbers end, an `up` along the view, and as
    /// [`Camera::new`].
    pub fn look_at(
        eye: T::Vec3,
        target: T::Vec3,
        up: T::Vec3,
        k: Intrinsics<T>,
        width: usize,
        height: usize,
    ) -> Result<Self, RasterError> {
        let (eye, target, up) = (T::from_vec3(eye), T::from_vec3(target), T::from_vec3(up));
        for (name, vector) in [("eye", eye), ("target", target), ("up", up)] {
            check_finite(name, &vector)?;
        }
        let bad = |reason| RasterError::BadCamera { reason };
        let forward = normalized(three(|i| target[i] - eye[i])).ok_or_else(|| {
            bad("expected a target at a distance from the eye that is neither 0 nor beyond the scalar's range")
        })?;
        let up = normalized(up).ok_or_else(|| bad("expected an upward direction, found none"))?;
        let across = cross(forward, up);
        if !(dot(across, across) > T::of(1e-10)) {
            return Err(bad(
                "expected an upward direction across the view, found one along it",
            ));
        }
        let right = normalized(across).unwrap_or(across);
        Self::with_axes(eye, right, forward, k, width, height)
    }

    /// A camera at `eye` with these unit vectors to its right and forward.
    fn with_axes(
        eye: [T; 3],
        right: [T; 3],
        forward: [T; 3],
        k: Intrinsics<T>,
        width: usize,
        height: usize,
    ) -> Result<Self, RasterError> {
        let down = cross(forward, right);
        let row = |axis: [T; 3]| [axis[0], axis[1], axis[2], -dot(axis, eye)];
        let last = [T::ZERO, T::ZERO, T::ZERO, T::ONE];
        Self::new([row(right), row(down), row(forward), last], k, width, height)
    }

    /// A camera on a sphere around `target`, which it looks at: `azimuth` turns about `up`, `elevation` raises above the
    /// plane across it, both in radians. Azimuth 0 is at the axis of the world that follows the one nearest to `up`, in
    /// the order x, y, z, x. At an elevation of a quarter turn the azimuth still says which way is up in the image.
    ///
    /// # Errors
    /// A number that is not finite, an `up` of length 0, and as [`Camera::new`].
    pub fn orbit(
        target: T::Vec3,
        distance: T,
        [azimuth, elevation]: [T; 2],
        up: T::Vec3,
        k: Intrinsics<T>,
        width: usize,
        height: usize,
    ) -> Result<Self, RasterError> {
        check_finite("target", &T::from_vec3(target))?;
        check_finite("distance", &[distance])?;
        check_finite("angles", &[azimuth, elevation])?;
        check_finite("up", &T::from_vec3(up))?;
        let axis = normalized(T::from_vec3(up)).ok_or(RasterError::BadCamera {
            reason: "expected an upward direction, found none",
        })?;
        let nearest = (0..3).fold(
            0,
            |best, i| if axis[i].abs() > axis[best].abs() { i } else { best },
        );
        let mut next = [T::ZERO; 3];
        next[(nearest + 1) % 3] = T::ONE;
        let lean = dot(next, axis);
        let start = normalized(three(|i| next[i] - lean * axis[i])).unwrap_or(next);
        let side = cross(axis, start);
        let (azimuth_sin, azimuth_cos) = azimuth.as_f64().sin_cos();
        let (elevation_sin, elevation_cos) = elevation.as_f64().sin_cos();
        let [a, b, c] = [
            elevation_cos * azimuth_cos,
            elevation_cos * azimuth_sin,
            elevation_sin,
        ]
        .map(T::of);
        let (centre, up) = (T::from_vec3(target), axis);
        let out = three(|i| a * start[i] + b * side[i] + c * up[i]);
        let eye = three(|i| centre[i] + distance * out[i]);
        let (sin, cos) = (T::of(azimuth_sin), T::of(azimuth_cos));
        let right = three(|i| cos * side[i] + -sin * start[i]);
        Self::with_axes(eye, right, out.map(|v| -v), k, width, height)
    }

    /// The world-to-camera transform.
    pub fn affine3(&self) -> T::Affine3 {
        T::to_affine3(self.mat4())
    }

    /// The world-to-camera matrix.
    pub fn mat4(&self) -> T::Mat4 {
        T::to_mat4(self.viewmat())
    }

    /// Where the camera is, in the world.
    pub fn eye(&self) -> T::Vec3 {
        T::to_vec3(self.centre())
    }
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DMat4, DQuat, DVec3};

    use super::*;

    const K: Intrinsics<f64> = Intrinsics {
        fx: 30.0,
        fy: 30.0,
        cx: 8.0,
        cy: 8.0,
    };

    #[test]
    fn matrices_go_in_and_out_unchanged() {
        let turn = DAffine3::from_rotation_translation(
            DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.7),
            DVec3::new(1.0, -2.0, 3.0),
        );
        let camera = Camera::from_affine3(turn, K, 16, 16).unwrap();
        assert_eq!(camera, Camera::from_mat4(DMat4::from(turn), K, 16, 16).unwrap());
        assert_eq!((camera.affine3(), camera.mat4()), (turn, DMat4::from(turn)));
        assert_eq!(camera.viewmat()[0][3], 1.0);
        // The camera's own place is where the transform has its origin.
        assert!(turn.transform_point3(camera.eye()).length() < 1e-12);
    }

    #[test]
    fn a_camera_sees_what_it_looks_at_in_the_middle_and_the_right_way_up() {
        let (eye, target, up) = (DVec3::new(3.0, 1.0, -2.0), DVec3::new(0.5, 0.2, 0.1), DVec3::Y);
        let camera = Camera::look_at(eye, target, up, K, 16, 16).unwrap();
        let seen = camera.affine3().transform_point3(target);
        assert!(seen.truncate().length() < 1e-12 && seen.z > 0.0);
        assert!((seen.z - eye.distance(target)).abs() < 1e-12 && camera.eye().distance(eye) < 1e-12);
        // Image rows grow downwards.
        assert!(camera.affine3().transform_point3(target + 0.1 * up).y < 0.0);
        assert!((DMat4::determinant(&camera.mat4()) - 1.0).abs() < 1e-12);
        for (eye, up) in [(target, up), (target + up, up), (eye, DVec3::ZERO)] {
            let refused = Camera::look_at(eye, target, up, K, 16, 16);
            assert!(matches!(refused, Err(RasterError::BadCamera { .. })));
        }
    }

    #[test]
    fn places_that_are_not_finite_are_told_by_name() {
        let (nan, far) = (DVec3::NAN, DVec3::splat(f64::INFINITY));
        let refused = |name| Err(RasterError::NotFinite { name, index: 0 });
        let (origin, z, y) = (DVec3::ZERO, DVec3::Z, DVec3::Y);
        assert_eq!(Camera::look_at(nan, z, y, K, 16, 16), refused("eye"));
        assert_eq!(Camera::look_at(origin, far, y, K, 16, 16), refused("target"));
        assert_eq!(Camera::look_at(origin, z, nan, K, 16, 16), refused("up"));
        assert_eq!(Camera::orbit(far, 1.0, [0.0; 2], y, K, 16, 16), refused("target"));
        assert_eq!(
            Camera::orbit(z, f64::NAN, [0.0; 2], y, K, 16, 16),
            refused("distance")
        );
        assert_eq!(
            Camera::orbit(z, 1.0, [f64::INFINITY, 0.0], y, K, 16, 16),
            refused("angles")
        );
        assert_eq!(Camera::orbit(z, 1.0, [0.0; 2], nan, K, 16, 16), refused("up"));
        // Finite places further apart than numbers reach.
        let beyond = Camera::look_at(DVec3::splat(1e308), DVec3::splat(-1e308), y, K, 16, 16);
        assert!(matches!(beyond, Err(RasterError::BadCamera { .. })));
    }

    #[test]
    fn orbits_keep_their_distance_and_turn_about_up() {
        let target = DVec3::new(1.0, 2.0, 3.0);
        for up in [DVec3::Z, -DVec3::Y, DVec3::new(0.2, 0.9, 0.1)] {
            let unit = up.normalize();
            let around = |azimuth, elevation| {
                let camera = Camera::orbit(target, 2.5, [azimuth, elevation], up, K, 16, 16).unwrap();
                camera.eye() - target
            };
            assert!((around(0.7, std::f64::consts::FRAC_PI_2) - 2.5 * unit).length() < 1e-12);
            let (start, quarter) = (around(0.0, 0.0), around(std::f64::consts::FRAC_PI_2, 0.0));
            assert!(start.dot(unit).abs() < 1e-12 && start.dot(quarter).abs() < 1e-12);
            assert!((start.cross(quarter).normalize() - unit).length() < 1e-12);
            for (azimuth, elevation) in [(0.3, 0.4), (-2.0, -1.2)] {
                let out = around(azimuth, elevation);
                assert!((out.length() - 2.5).abs() < 1e-12);
                assert!((out.dot(unit) - 2.5 * elevation.sin()).abs() < 1e-12);
            }
        }
    }
}
