//! Compiles the stages in this crate, once for each scalar.
//!
//! A generic function is compiled by the crate that says which types it is for, with that crate's settings and again
//! after each of its changes. The debug build of a program would hold debug kernels even where this crate is optimised,
//! and every build of it would spend seconds on them. So the stages are reached through these functions, which are
//! not generic.

use crate::binned::Binned;
use crate::bins::BinScratch;
use crate::composite::{Canvas, composite};
use crate::composite_vjp::{CompositeGradients, Cotangents, composite_vjp};
use crate::error::RasterError;
use crate::gaussians::first_not_finite;
use crate::kernel::Channels;
use crate::median::medians;
use crate::pool::Pooled;
use crate::project::ScreenInfo;
use crate::project_vjp::project_view_vjp;
use crate::real::Real;
use crate::scene::Scene;
use crate::settings::Limits;
use crate::sh::{Harmonics, HarmonicsGradients};
use crate::tiles::TileGrid;
use crate::view::{View, ViewGradients};

/// The stages for a scalar.
#[allow(unreachable_pub, missing_docs, private_interfaces)]
pub trait Compiled: Sized {
    fn first_not_finite(values: &[Self]) -> Option<usize>;
    fn project(
        binned: &mut Binned<Self>,
        view: &View<'_, Self>,
        limits: &Limits<Self>,
        grid: &TileGrid,
        wanted: Option<&[bool]>,
        screen: ScreenInfo<'_, Self>,
    );
    fn bin(
        binned: &mut Binned<Self>,
        grid: &TileGrid,
        scratch: &mut BinScratch<Self>,
    ) -> Result<(), RasterError>
    where
        Self: Real;
    fn composite(scene: &Scene<'_, Self>, colors: &mut [Self], alphas: &mut [Self]) -> Pooled<Canvas<Self>>
    where
        Self: Real;
    fn composite_vjp(
        scene: &Scene<'_, Self>,
        canvas: &Canvas<Self>,
        v: Cotangents<'_, Self>,
        absolute: bool,
    ) -> CompositeGradients<Self>
    where
        Self: Real;
    fn medians(scene: &Scene<'_, Self>, canvas: &Canvas<Self>) -> Vec<i32>;
    fn project_vjp(
        view: &View<'_, Self>,
        limits: &Limits<Self>,
        binned: &Binned<Self>,
        channels: Channels<'_, Self>,
        slots: &[Self],
        out: ViewGradients<'_, Self>,
    );
    fn harmonics(harmonics: &Harmonics<'_, Self>) -> Vec<[Self; 3]>;
    fn harmonics_vjp(
        harmonics: &Harmonics<'_, Self>,
        v_colors: &[[Self; 3]],
        out: &mut HarmonicsGradients<Self>,
    );
}

macro_rules! compiled {
    ($T:ty) => {
        #[allow(private_interfaces)]
        impl Compiled for $T {
            fn first_not_finite(values: &[Self]) -> Option<usize> {
                first_not_finite(values)
            }

            fn project(
                binned: &mut Binned<Self>,
                view: &View<'_, Self>,
                limits: &Limits<Self>,
                grid: &TileGrid,
                wanted: Option<&[bool]>,
                screen: ScreenInfo<'_, Self>,
            ) {
                binned.project(view, limits, grid, wanted, screen);
            }

            fn bin(
                binned: &mut Binned<Self>,
                grid: &TileGrid,
                scratch: &mut BinScratch<Self>,
            ) -> Result<(), RasterError> {
                binned.bin(grid, scratch)
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
                view: &View<'_, Self>,
                limits: &Limits<Self>,
                binned: &Binned<Self>,
                channels: Channels<'_, Self>,
                slots: &[Self],
                out: ViewGradients<'_, Self>,
            ) {
                project_view_vjp(view, limits, binned, channels, slots, out);
            }

            fn harmonics(harmonics: &Harmonics<'_, Self>) -> Vec<[Self; 3]> {
                harmonics.values()
            }

            fn harmonics_vjp(
                harmonics: &Harmonics<'_, Self>,
                v_colors: &[[Self; 3]],
                out: &mut HarmonicsGradients<Self>,
            ) {
                harmonics.add_vjp(v_colors, out);
            }
        }
    };
}
compiled!(f32);
compiled!(f64);
