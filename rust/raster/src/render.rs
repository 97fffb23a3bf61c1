//! One view from Gaussians to image and back: the stages in order.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::camera::Camera;
use crate::chunk::{CHUNK, ChunkGradients, ChunkSplats, is_sound};
use crate::composite::{Canvas, Cotangents, Scene};
use crate::dispatch::SimdLevel;
use crate::error::RasterError;
use crate::gaussians::{Gaussians, check_finite, check_length};
use crate::kernel::{ABSOLUTES, Channels, MOMENTS};
use crate::levels;
use crate::pool::{Buffers, Pooled, bytes_of, stale};
use crate::project::{Lens, ScreenInfo, Splat};
use crate::real::Real;
use crate::settings::{Limits, RasterSettings, RenderMode};
use crate::tiles::{BinScratch, Cover, TileBins, TileGrid, bin_tiles};
use crate::vector::prefetch;

/// (Gaussian, tile) pairs that are listed while projecting. With more, the rest is first only counted: should they be
/// more than can be numbered, that is to be said before they fill the memory.
const PATIENCE: usize = 1 << 26;

/// Slots that are asked for ahead of the one being summed.
const AHEAD: usize = 16;

/// Everything one image is made of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View<'a, T> {
    pub(crate) gaussians: Gaussians<'a, T>,
    pub(crate) camera: Camera<T>,
    pub(crate) background: Option<&'a [T]>,
    pub(crate) pixel_mask: Option<&'a [bool]>,
}

/// Where an image goes.
pub(crate) struct Image<'a, T> {
    pub(crate) colors: &'a mut [T],
    pub(crate) alphas: &'a mut [T],
    pub(crate) screen: ScreenInfo<'a, T>,
}

/// A view's splats and which tiles they reach.
#[derive(Debug)]
pub(crate) struct Binned<T> {
    /// By Gaussian; anything for one that no pixel sees.
    pub(crate) splats: Vec<Splat<T>>,
    /// By chunk of Gaussians.
    covers: Vec<Cover>,
    pub(crate) bins: TileBins,
}

impl<T> Default for Binned<T> {
    fn default() -> Self {
        Self {
            splats: Vec::new(),
            covers: Vec::new(),
            bins: TileBins::default(),
        }
    }
}

impl<T: Real> Buffers for Binned<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.splats) + self.covers.iter().map(Cover::bytes).sum::<usize>() + self.bins.bytes()
    }
}

impl<T: Real> Buffers for BinScratch<T> {
    fn bytes(&self) -> usize {
        self.bytes()
    }
}

impl<T: Real> Binned<T> {
    fn chunks(&self) -> &[Cover] {
        &self.covers[..self.splats.len().div_ceil(CHUNK)]
    }

    /// Projects the Gaussians of a view and finds the tiles that each reaches.
    pub(crate) fn project(
        &mut self,
        view: &View<'_, T>,
        limits: &Limits<T>,
        grid: &TileGrid,
        wanted: Option<&[bool]>,
        screen: ScreenInfo<'_, T>,
    ) {
        let n = view.gaussians.len();
        let chunks = n.div_ceil(CHUNK);
        if self.covers.len() < chunks {
            self.covers.resize_with(chunks, Cover::default);
        }
        let (lens, level) = (Lens::new(&view.camera, limits), SimdLevel::detect());
        let ScreenInfo {
            means2d,
            depths,
            radii,
        } = screen;
        for patience in [PATIENCE, usize::MAX] {
            let pairs = AtomicUsize::new(0);
            (
                stale(&mut self.splats, n).par_chunks_mut(CHUNK),
                self.covers[..chunks].par_iter_mut(),
                means2d.par_chunks_mut(CHUNK),
                depths.par_chunks_mut(CHUNK),
                radii.par_chunks_mut(CHUNK),
            )
                .into_par_iter()
                .enumerate()
                .for_each(|(chunk, (splats, cover, means2d, depths, radii))| {
                    cover.counting = pairs.load(Ordering::Relaxed) > patience;
                    let screen = ScreenInfo {
                        means2d,
                        depths,
                        radii,
                    };
                    let out = ChunkSplats {
                        splats,
                        screen,
                        cover: &mut *cover,
                    };
                    levels::project(level, &view.gaussians, chunk * CHUNK, &lens, grid, wanted, out);
                    pairs.fetch_add(cover.count(), Ordering::Relaxed);
                });
            let pairs = pairs.into_inner();
            if pairs <= patience || u32::try_from(pairs).is_err() {
                break;
            }
        }
    }

    /// Sorts the projected splats by depth and lists those of every tile.
    pub(crate) fn bin(&mut self, grid: &TileGrid, scratch: &mut BinScratch<T>) -> Result<(), RasterError> {
        let chunks = self.splats.len().div_ceil(CHUNK);
        let covers = &mut self.covers[..chunks];
        bin_tiles(&self.splats, covers, grid.len(), scratch, &mut self.bins)
    }
}

/// What the forward pass of a view keeps for the backward pass.
#[derive(Debug)]
pub(crate) struct ViewState<T: Real> {
    grid: TileGrid,
    limits: Limits<T>,
    binned: Pooled<Binned<T>>,
    canvas: Pooled<Canvas<T>>,
}

impl<T: Real> ViewState<T> {
    pub(crate) fn visible(&self) -> usize {
        self.binned.chunks().iter().map(|cover| cover.visible).sum()
    }

    /// See [`Frame::median_ids`].
    pub(crate) fn median_ids(&self) -> Vec<i32> {
        let scene = Scene {
            grid: self.grid,
            bins: &self.binned.bins,
            splats: &self.binned.splats,
            // Only whom light reaches is asked, not with which colour.
            channels: Channels {
                colors: &[],
                stride: 0,
                total: 1,
                colored: 0,
            },
            expected_depth: false,
            background: None,
            pixel_mask: None,
            limits: &self.limits,
        };
        T::medians(&scene, &self.canvas)
    }

    pub(crate) fn culled(&self) -> usize {
        self.binned.splats.len() - self.visible()
    }

    pub(crate) fn intersections(&self) -> usize {
        self.binned.bins.ranks.len()
    }

    pub(crate) fn saturated(&self) -> usize {
        self.canvas.saturated
    }

    pub(crate) fn empty_tiles(&self) -> usize {
        self.binned
            .bins
            .offsets
            .windows(2)
            .filter(|pair| pair[0] == pair[1])
            .count()
    }
}

/// Where the gradients of a view go; an empty slice is one that nobody asked for.
pub(crate) struct ViewGradients<'a, T> {
    pub(crate) means: &'a mut [[T; 3]],
    pub(crate) quats: &'a mut [[T; 4]],
    pub(crate) scales: &'a mut [[T; 3]],
    pub(crate) opacities: &'a mut [T],
    pub(crate) colors: &'a mut [T],
    pub(crate) viewmat: &'a mut [T],
    pub(crate) background: &'a mut [T],
    pub(crate) means2d: &'a mut [[T; 2]],
    /// Leave what passes through `means2d` out of the others.
    pub(crate) detach_means2d: bool,
    /// Sums over pixels of the absolute values of the parts of `means2d`.
    pub(crate) absgrad: &'a mut [[T; 2]],
}

fn channels_of<'a, T>(gaussians: &Gaussians<'a, T>, mode: RenderMode) -> Channels<'a, T> {
    let colored = if mode.has_colors() { gaussians.channels } else { 0 };
    Channels {
        colors: gaussians.colors,
        stride: gaussians.channels,
        total: colored + usize::from(mode.has_depth()),
        colored,
    }
}

pub(crate) fn scene<'a, T: Real>(
    view: &View<'a, T>,
    mode: RenderMode,
    limits: &'a Limits<T>,
    binned: &'a Binned<T>,
) -> Scene<'a, T> {
    Scene {
        grid: TileGrid::new(view.camera.width, view.camera.height, limits.tile_size),
        bins: &binned.bins,
        splats: &binned.splats,
        channels: channels_of(&view.gaussians, mode),
        expected_depth: mode.expects_depth(),
        background: view.background,
        pixel_mask: view.pixel_mask,
        limits,
    }
}

/// Which tiles hold a pixel to be rendered.
fn wanted_tiles(mask: &[bool], grid: &TileGrid) -> Vec<bool> {
    let mut wanted = vec![false; grid.len()];
    for (y, row) in mask.chunks_exact(grid.width).enumerate() {
        let first = y / grid.tile_size * grid.columns;
        for (column, pixels) in row.chunks(grid.tile_size).enumerate() {
            wanted[first + column] |= pixels.contains(&true);
        }
    }
    wanted
}

/// Renders one view.
pub(crate) fn render_view<T: Real>(
    view: &View<'_, T>,
    mode: RenderMode,
    limits: &Limits<T>,
    image: Image<'_, T>,
) -> Result<ViewState<T>, RasterError> {
    let grid = TileGrid::new(view.camera.width, view.camera.height, limits.tile_size);
    let wanted = view.pixel_mask.map(|mask| wanted_tiles(mask, &grid));
    let mut binned = Pooled::<Binned<T>>::take();
    T::project(&mut binned, view, limits, &grid, wanted.as_deref(), image.screen);
    T::bin(&mut binned, &grid, &mut Pooled::take())?;
    let canvas = T::composite(&scene(view, mode, limits, &binned), image.colors, image.alphas);
    Ok(ViewState {
        grid,
        limits: *limits,
        binned,
        canvas,
    })
}

/// Consecutive pieces of `values`, or `count` empty ones if there are no values.
fn pieces<U>(values: &mut [U], size: usize, count: usize) -> Vec<&mut [U]> {
    if values.is_empty() {
        (0..count).map(|_| [].as_mut_slice()).collect()
    } else {
        values.chunks_mut(size).collect()
    }
}

/// The slots of a view's vjp: `MOMENTS` + channels values per entry of [`TileBins::ranks`], and absolutes if any.
#[derive(Clone, Copy)]
struct Slots<'a, T> {
    values: &'a [T],
    channels: Channels<'a, T>,
    absolute: bool,
}

impl<T: Real> Slots<'_, T> {
    fn size(&self) -> usize {
        MOMENTS + self.channels.total + if self.absolute { ABSOLUTES } else { 0 }
    }

    /// Sums the absolutes of one Gaussian, tile by tile.
    fn sum_absolutes(&self, positions: &[u32]) -> [T; ABSOLUTES] {
        let mut sums = [T::ZERO; ABSOLUTES];
        for &position in positions {
            let slot = &self.values[position as usize * self.size()..][..self.size()];
            for (sum, &v) in sums.iter_mut().zip(&slot[MOMENTS + self.channels.total..]) {
                *sum += v;
            }
        }
        sums
    }

    /// Asks for the memory of a slot.
    #[inline(always)]
    fn prefetch(&self, position: u32) {
        let first = position as usize * self.size();
        prefetch(self.values, first);
        prefetch(self.values, first + self.size() - 1);
    }

    /// Sums the slots of one Gaussian, tile by tile. Adds the gradients of its colours to `colors` (none if empty);
    /// returns the moments and the gradient of depth as a channel.
    #[inline(always)]
    fn sum(&self, positions: &[u32], colors: &mut [T]) -> [T; MOMENTS + 1] {
        const RGB: usize = MOMENTS + 3;
        let Channels { total, colored, .. } = self.channels;
        let size = self.size();
        let mut sums = [T::ZERO; MOMENTS + 1];
        if total == 3 && colored == 3 && !self.absolute {
            // The usual case in registers.
            let mut all = [T::ZERO; RGB];
            let slots = self.values.as_chunks::<RGB>().0;
            for &position in positions {
                let slot = &slots[position as usize];
                for k in 0..RGB {
                    all[k] += slot[k];
                }
            }
            sums[..MOMENTS].copy_from_slice(&all[..MOMENTS]);
            for (sum, &v) in colors.iter_mut().zip(&all[MOMENTS..]) {
                *sum += v;
            }
            return sums;
        }
        for &position in positions {
            let slot = &self.values[position as usize * size..][..size];
            for k in 0..MOMENTS {
                sums[k] += slot[k];
            }
            for (sum, &v) in colors.iter_mut().zip(&slot[MOMENTS..MOMENTS + colored]) {
                *sum += v;
            }
            if total > colored {
                sums[MOMENTS] += slot[MOMENTS + colored];
            }
        }
        sums
    }
}

/// A gradient, or none if it is beyond the scalar's range, as in [`crate::chunk::vjp_chunk`]; `from` is what it was made of.
#[inline(always)]
fn kept<T: Real>(gradient: [T; 2], from: [T; 2]) -> [T; 2] {
    if !is_sound(gradient) & is_sound(from) {
        [T::ZERO; 2]
    } else {
        gradient
    }
}

/// Gradient of a splat's centre in pixels, from its first moments Σ h u and Σ h v.
#[inline(always)]
fn centre_vjp<T: Real>(splat: &Splat<T>, [u, v]: [T; 2]) -> [T; 2] {
    let gain = T::of(2.0 * std::f64::consts::LN_2) * splat.opacity;
    kept(
        [gain * splat.w11 * u, gain * (splat.w12 * u + splat.w22 * v)],
        [u, v],
    )
}

/// The vjp of [`render_view`]; returns how many tiles had no incoming gradient. Gradients are added.
pub(crate) fn render_view_vjp<T: Real>(
    view: &View<'_, T>,
    mode: RenderMode,
    limits: &Limits<T>,
    state: &ViewState<T>,
    v: Cotangents<'_, T>,
    out: ViewGradients<'_, T>,
) -> usize {
    let scene = scene(view, mode, limits, &state.binned);
    let gradients = T::composite_vjp(&scene, &state.canvas, v, !out.absgrad.is_empty());
    for (sum, &v) in out.background.iter_mut().zip(&gradients.background) {
        *sum += v;
    }
    T::project_vjp(
        view,
        limits,
        &state.binned,
        scene.channels,
        gradients.slots.values(),
        out,
    );
    gradients.tiles_skipped
}

/// Gradients of the Gaussians and of the camera, given what the compositor's vjp left in its slots.
pub(crate) fn project_view_vjp<T: Real>(
    view: &View<'_, T>,
    limits: &Limits<T>,
    binned: &Binned<T>,
    channels: Channels<'_, T>,
    slots: &[T],
    out: ViewGradients<'_, T>,
) {
    let slots = Slots {
        values: slots,
        channels,
        absolute: !out.absgrad.is_empty(),
    };
    let (stride, colored) = (channels.stride, channels.colored);
    let camera = !out.viewmat.is_empty();
    let geometry = camera
        || !(out.means.is_empty()
            && out.quats.is_empty()
            && out.scales.is_empty()
            && out.opacities.is_empty());
    if !geometry
        && out.means2d.is_empty()
        && out.absgrad.is_empty()
        && (out.colors.is_empty() || colored == 0)
    {
        return;
    }
    let (lens, level) = (Lens::new(&view.camera, limits), SimdLevel::detect());
    let covers = binned.chunks();
    let positions = &binned.bins.positions;
    let count = covers.len();
    let v_viewmats: Vec<[[T; 4]; 3]> = (
        pieces(out.means, CHUNK, count),
        pieces(out.quats, CHUNK, count),
        pieces(out.scales, CHUNK, count),
        pieces(out.opacities, CHUNK, count),
        pieces(out.colors, CHUNK * stride.max(1), count),
        pieces(out.means2d, CHUNK, count),
        pieces(out.absgrad, CHUNK, count),
        covers,
    )
        .into_par_iter()
        .enumerate()
        .map(
            |(chunk, (means, quats, scales, opacities, colors, means2d, absgrad, cover))| {
                let mut v = ChunkGradients::new();
                for local in 0..cover.len() {
                    let own = cover.pairs_of(local);
                    if own.is_empty() {
                        continue;
                    }
                    // Slots lie tile by tile: one Gaussian's, and the next one's, are far apart.
                    for &position in positions.iter().skip(own.start + AHEAD).take(own.len()) {
                        slots.prefetch(position);
                    }
                    let own = &positions[own];
                    let v_colors = if colors.is_empty() {
                        &mut []
                    } else {
                        &mut colors[local * stride..][..colored]
                    };
                    let mut sums = slots.sum(own, v_colors);
                    let splat = &binned.splats[chunk * CHUNK + local];
                    if let Some(v) = absgrad.get_mut(local) {
                        let gain = T::of(2.0 * std::f64::consts::LN_2) * splat.opacity;
                        let [x, y] = slots.sum_absolutes(own);
                        *v = kept([gain * splat.w11 * x, gain * y], [x, y]);
                    }
                    if let Some(v) = means2d.get_mut(local) {
                        *v = centre_vjp(splat, [sums[1], sums[2]]);
                        if out.detach_means2d {
                            sums[1..3].fill(T::ZERO);
                        }
                    }
                    v.push(local, sums);
                }
                if geometry && v.len > 0 {
                    levels::vjp(level, &view.gaussians, chunk * CHUNK, &lens, camera, &mut v);
                    v.add_to(means, quats, scales, opacities);
                }
                v.viewmat
            },
        )
        .collect();
    if camera {
        for v in &v_viewmats {
            for (sum, &v) in out.viewmat.iter_mut().zip(v.as_flattened()) {
                *sum += v;
            }
        }
    }
}

/// A rendered image.
#[derive(Debug)]
pub struct Frame<T: Real> {
    /// Rows, columns, channels: the colours, then depth if the mode has it.
    pub colors: Vec<T>,
    /// Rows, columns.
    pub alphas: Vec<T>,
    /// Centres on screen in pixels; zeros for a Gaussian that no pixel sees.
    pub means2d: Vec<[T; 2]>,
    /// Camera z; zero for a Gaussian that no pixel sees.
    pub depths: Vec<T>,
    /// Half the extent on screen in pixels, along x and y; zero for a Gaussian that no pixel sees.
    pub radii: Vec<[i32; 2]>,
    state: ViewState<T>,
}

impl<T: Real> Frame<T> {
    /// The Gaussian at which half of each pixel's light is gone, by rows and columns: the last of those that more than
    /// half reaches, as in 2D Gaussian splatting. −1 where nothing is seen. Its depth is the pixel's median depth, and
    /// has the gradient of that.
    #[must_use]
    pub fn median_ids(&self) -> Vec<i32> {
        self.state.median_ids()
    }
}

/// Gradients of all inputs of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct GaussianGrads<T> {
    /// Of the centres.
    pub means: Vec<[T; 3]>,
    /// Of the raw quaternions.
    pub quats: Vec<[T; 4]>,
    /// Of the standard deviations.
    pub scales: Vec<[T; 3]>,
    /// Of the opacities.
    pub opacities: Vec<T>,
    /// Of the colours.
    pub colors: Vec<T>,
    /// Of the first three rows of the world-to-camera matrix.
    pub viewmat: [[T; 4]; 3],
    /// Of the background.
    pub background: Vec<T>,
    /// Of the centres on screen, per pixel: what densification strategies watch. Already contained in the others.
    pub means2d: Vec<[T; 2]>,
    /// Sums over pixels of the absolute values of what `means2d` sums; empty unless [`Renderer::with_absgrad`].
    pub absgrad: Vec<[T; 2]>,
}

impl<T: Real> GaussianGrads<T> {
    pub(crate) fn zeros(gaussians: &Gaussians<'_, T>, absgrad: bool) -> Self {
        let n = gaussians.len();
        Self {
            means: vec![[T::ZERO; 3]; n],
            quats: vec![[T::ZERO; 4]; n],
            scales: vec![[T::ZERO; 3]; n],
            opacities: vec![T::ZERO; n],
            colors: vec![T::ZERO; n * gaussians.channels],
            viewmat: [[T::ZERO; 4]; 3],
            background: vec![T::ZERO; gaussians.channels],
            means2d: vec![[T::ZERO; 2]; n],
            absgrad: vec![[T::ZERO; 2]; if absgrad { n } else { 0 }],
        }
    }

    /// Where a view's vjp adds them.
    pub(crate) fn slices(&mut self) -> ViewGradients<'_, T> {
        ViewGradients {
            means: &mut self.means,
            quats: &mut self.quats,
            scales: &mut self.scales,
            opacities: &mut self.opacities,
            colors: &mut self.colors,
            viewmat: self.viewmat.as_flattened_mut(),
            background: &mut self.background,
            means2d: &mut self.means2d,
            detach_means2d: false,
            absgrad: &mut self.absgrad,
        }
    }
}

/// Renders single views.
#[derive(Clone, Debug)]
pub struct Renderer<T> {
    limits: Limits<T>,
    mode: RenderMode,
    absgrad: bool,
}

impl<T: Real> Renderer<T> {
    /// A renderer with these rules.
    ///
    /// # Errors
    /// A setting outside its range.
    pub fn new(settings: &RasterSettings, mode: RenderMode) -> Result<Self, RasterError> {
        Ok(Self {
            limits: Limits::new(settings)?,
            mode,
            absgrad: false,
        })
    }

    /// The same renderer, whose gradients hold absolute ones on screen as well, which some densification strategies
    /// (AbsGS) read. With more than eight channels a pixel's part is that of eight at a time.
    #[must_use]
    pub fn with_absgrad(self) -> Self {
        Self {
            absgrad: true,
            ..self
        }
    }

    /// Renders Gaussians; `background` has one value per colour channel (black if absent).
    ///
    /// # Errors
    /// A background of the wrong length or with a value that is not finite.
    pub fn render(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
    ) -> Result<Frame<T>, RasterError> {
        if let Some(values) = background {
            check_length("backgrounds", gaussians.channels, values.len())?;
            check_finite("backgrounds", values)?;
        }
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background,
            pixel_mask: None,
        };
        let (n, pixels) = (gaussians.len(), camera.width * camera.height);
        let total = channels_of(gaussians, self.mode).total;
        let mut colors = vec![T::ZERO; pixels * total];
        let mut alphas = vec![T::ZERO; pixels];
        let (mut means2d, mut depths, mut radii) = (vec![[T::ZERO; 2]; n], vec![T::ZERO; n], vec![[0; 2]; n]);
        let image = Image {
            colors: &mut colors,
            alphas: &mut alphas,
            screen: ScreenInfo {
                means2d: &mut means2d,
                depths: &mut depths,
                radii: &mut radii,
            },
        };
        let state = render_view(&view, self.mode, &self.limits, image)?;
        Ok(Frame {
            colors,
            alphas,
            means2d,
            depths,
            radii,
            state,
        })
    }

    /// Gradients of a loss with respect to all inputs of [`Renderer::render`], given its gradients with respect to
    /// the frame's colours and alphas. Call it with the inputs that made the frame.
    ///
    /// # Errors
    /// Gradients whose length is not that of the frame's arrays.
    pub fn render_vjp(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
        frame: &Frame<T>,
        v_colors: &[T],
        v_alphas: &[T],
    ) -> Result<GaussianGrads<T>, RasterError> {
        check_length("v_colors", frame.colors.len(), v_colors.len())?;
        check_length("v_alphas", frame.alphas.len(), v_alphas.len())?;
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background,
            pixel_mask: None,
        };
        let mut grads = GaussianGrads::zeros(gaussians, self.absgrad);
        let v = Cotangents {
            colors: v_colors,
            alphas: v_alphas,
        };
        render_view_vjp(&view, self.mode, &self.limits, &frame.state, v, grads.slices());
        Ok(grads)
    }
}
