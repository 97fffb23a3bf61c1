//! Gaussians that own their arrays, made from glam's vectors and quaternions.

use crate::error::RasterError;
use crate::input::gaussians::Gaussians;
use crate::input::glam::GlamTypes;
use crate::math::real::Real;

/// Gaussians that own their arrays, in this crate's layout: for callers whose own layout is another, such as glam's.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OwnedGaussians<T> {
    /// Centres in the world.
    pub means: Vec<[T; 3]>,
    /// Rotations, w x y z.
    pub quats: Vec<[T; 4]>,
    /// Standard deviations along the rotated axes.
    pub scales: Vec<[T; 3]>,
    /// Opacities.
    pub opacities: Vec<T>,
    /// `channels` values per Gaussian.
    pub colors: Vec<T>,
    /// Values per Gaussian in `colors`.
    pub channels: usize,
}

impl<T: GlamTypes> OwnedGaussians<T> {
    /// Copies glam's vectors and quaternions. glam stores a quaternion as x y z w, this crate as w x y z; the order is
    /// converted.
    #[must_use]
    pub fn from_glam(
        means: &[T::Vec3],
        quats: &[T::Quat],
        scales: &[T::Vec3],
        opacities: &[T],
        colors: &[T],
        channels: usize,
    ) -> Self {
        Self {
            means: means.iter().map(|&v| T::from_vec3(v)).collect(),
            quats: quats.iter().map(|&q| T::from_quat(q)).collect(),
            scales: scales.iter().map(|&v| T::from_vec3(v)).collect(),
            opacities: opacities.to_vec(),
            colors: colors.to_vec(),
            channels,
        }
    }
}

impl<T: Real> OwnedGaussians<T> {
    /// What a renderer takes.
    ///
    /// # Errors
    /// As [`Gaussians::new`].
    pub fn view(&self) -> Result<Gaussians<'_, T>, RasterError> {
        Gaussians::new(
            &self.means,
            &self.quats,
            &self.scales,
            &self.opacities,
            &self.colors,
            self.channels,
        )
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::math::covariance::{dot, rotation_of, three};

    #[test]
    fn quaternions_of_glam_are_turned_into_this_crates_order() {
        let quat = DQuat::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), 1.1);
        let owned = OwnedGaussians::from_glam(
            &[DVec3::new(0.1, 0.2, 2.0)],
            &[quat],
            &[DVec3::ONE],
            &[0.5],
            &[1.0],
            1,
        );
        assert_eq!(owned.quats, [[quat.w, quat.x, quat.y, quat.z]]);
        assert_eq!(f64::to_quat(owned.quats[0]), quat);
        assert!(owned.view().is_ok());
        // The rotation is glam's.
        let axes = rotation_of(owned.quats[0]);
        let turned = quat * DVec3::new(0.3, -0.4, 0.5);
        let own = three(|i| dot(axes[i], [0.3, -0.4, 0.5]));
        assert!((DVec3::from_array(own) - turned).length() < 1e-12);
    }
}
