//! The scalars that the stages are compiled for, in this crate.
//!
//! A generic function is compiled by the crate that says which types it is for, with that crate's settings and again
//! after each of its changes. The debug build of a program would hold debug kernels even where this crate is optimised,
//! and every build of it would spend seconds on them. So the stages are reached through these functions, which are
//! not generic.

use crate::backproject::gradients::{ViewGradients, project_view_vjp};
use crate::color::harmonics::{HarmonicSums, HarmonicsGradients};
use crate::composite::backward::{CompositeGradients, composite_vjp};
use crate::composite::forward::{Canvas, composite};
use crate::composite::incoming::Cotangents;
use crate::composite::median::medians;
use crate::composite::scene::Scene;
use crate::error::RasterError;
use crate::input::camera::Camera;
use crate::input::channels::Channels;
use crate::input::gaussians::Gaussians;
use crate::input::glam::GlamTypes;
use crate::input::settings::Limits;
use crate::lists::tile_lists::{ListScratch, TileLists, bin_splats};
use crate::memory::pool::Pooled;
use crate::project::projected::Projected;
use crate::project::splat::ScreenInfo;
use crate::project::tiles::TileGrid;
use crate::simd::Vectors;

/// A scalar that the renderer is compiled for: `f32` or `f64`. Sealed, as [`Real`](crate::Real) is; its functions are
/// not for callers.
#[allow(private_interfaces, private_bounds, missing_docs)]
pub trait Scalar: Vectors + GlamTypes {
    fn project(
        projected: &mut Projected<Self>,
        gaussians: &Gaussians<'_, Self>,
        channels: Channels<'_, Self>,
        camera: &Camera<Self>,
        limits: &Limits<Self>,
        grid: &TileGrid,
        wanted: Option<&[bool]>,
        screen: ScreenInfo<'_, Self>,
    );
    fn bin(
        projected: &mut Projected<Self>,
        tiles: usize,
        scratch: &mut ListScratch<Self>,
        lists: &mut TileLists,
    ) -> Result<(), RasterError>;
    fn composite(scene: &Scene<'_, Self>, colors: &mut [Self], alphas: &mut [Self]) -> Pooled<Canvas<Self>>;
    fn composite_vjp(
        scene: &Scene<'_, Self>,
        canvas: &Canvas<Self>,
        v: Cotangents<'_, Self>,
        absolute: bool,
    ) -> CompositeGradients<Self>;
    fn medians(scene: &Scene<'_, Self>, canvas: &Canvas<Self>) -> Vec<i32>;
    fn project_vjp(
        gaussians: &Gaussians<'_, Self>,
        camera: &Camera<Self>,
        limits: &Limits<Self>,
        projected: &Projected<Self>,
        channels: Channels<'_, Self>,
        intersections: &[Self],
        out: ViewGradients<'_, Self>,
    );
    fn harmonics(harmonics: &HarmonicSums<'_, Self>) -> Vec<[Self; 3]>;
    fn harmonics_vjp(
        harmonics: &HarmonicSums<'_, Self>,
        v_colors: &[[Self; 3]],
        out: &mut HarmonicsGradients<Self>,
    );
}

macro_rules! scalar {
    ($T:ty) => {
        #[allow(private_interfaces)]
        impl Scalar for $T {
            fn project(
                projected: &mut Projected<Self>,
                gaussians: &Gaussians<'_, Self>,
                channels: Channels<'_, Self>,
                camera: &Camera<Self>,
                limits: &Limits<Self>,
                grid: &TileGrid,
                wanted: Option<&[bool]>,
                screen: ScreenInfo<'_, Self>,
            ) {
                projected.project(gaussians, channels, camera, limits, grid, wanted, screen);
            }

            fn bin(
                projected: &mut Projected<Self>,
                tiles: usize,
                scratch: &mut ListScratch<Self>,
                lists: &mut TileLists,
            ) -> Result<(), RasterError> {
                bin_splats(projected, tiles, scratch, lists)
            }

            fn composite(
                scene: &Scene<'_, Self>,
                colors: &mut [Self],
                alphas: &mut [Self],
            ) -> Pooled<Canvas<Self>> {
                composite(scene, colors, alphas)
            }

            fn composite_vjp(
                scene: &Scene<'_, Self>,
                canvas: &Canvas<Self>,
                v: Cotangents<'_, Self>,
                absolute: bool,
            ) -> CompositeGradients<Self> {
                composite_vjp(scene, canvas, v, absolute)
            }

            fn medians(scene: &Scene<'_, Self>, canvas: &Canvas<Self>) -> Vec<i32> {
                medians(scene, canvas)
            }

            fn project_vjp(
                gaussians: &Gaussians<'_, Self>,
                camera: &Camera<Self>,
                limits: &Limits<Self>,
                projected: &Projected<Self>,
                channels: Channels<'_, Self>,
                intersections: &[Self],
                out: ViewGradients<'_, Self>,
            ) {
                project_view_vjp(
                    gaussians,
                    camera,
                    limits,
                    projected,
                    channels,
                    intersections,
                    out,
                );
            }

            fn harmonics(harmonics: &HarmonicSums<'_, Self>) -> Vec<[Self; 3]> {
                harmonics.values()
            }

            fn harmonics_vjp(
                harmonics: &HarmonicSums<'_, Self>,
                v_colors: &[[Self; 3]],
                out: &mut HarmonicsGradients<Self>,
            ) {
                harmonics.add_vjp(v_colors, out);
            }
        }
    };
}
scalar!(f32);
scalar!(f64);
