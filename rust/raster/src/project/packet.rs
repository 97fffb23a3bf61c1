//! Projection and its vjp for a packet of Gaussians at once.
//!
//! A packet is transposed into columns, one per number, so that the loops over its Gaussians vectorise. Packets are the
//! unit of parallel work. Their size is fixed, so that sums over packets do not depend on the number of threads.

use crate::input::channels::Channels;
use crate::input::gaussians::Gaussians;
use crate::math::real::Real;
use crate::project::splat::{Projection, ScreenInfo, Splat, SplatGradient, extent, splat, splat_vjp};
use crate::project::tiles::{Cover, Cutter, Ellipse, TileGrid, padded_reach, pixel_range};

/// Gaussians in a packet.
pub(crate) const PACKET_SIZE: usize = 256;
/// Loops run over whole vectors, the last of which may reach beyond the packet's Gaussians.
const LANES: usize = 16;

/// Radii up to this many pixels are rounded in columns.
const MOST_EXACT: f64 = 4e6;

type Column<U> = [U; PACKET_SIZE];

/// The Gaussians of a packet: mean, quaternion, scale, opacity.
struct Columns<T>([Column<T>; 11]);

impl<T: Real> Columns<T> {
    fn new() -> Self {
        Self([[T::ZERO; PACKET_SIZE]; 11])
    }

    #[inline(always)]
    fn set(&mut self, lane: usize, gaussians: &Gaussians<'_, T>, i: usize) {
        let (mean, quat, scale) = (gaussians.means[i], gaussians.quats[i], gaussians.scales[i]);
        let columns = &mut self.0;
        [columns[0][lane], columns[1][lane], columns[2][lane]] = mean;
        [
            columns[3][lane],
            columns[4][lane],
            columns[5][lane],
            columns[6][lane],
        ] = quat;
        [columns[7][lane], columns[8][lane], columns[9][lane]] = scale;
        columns[10][lane] = gaussians.opacities[i];
    }

    #[inline(always)]
    fn get(&self, lane: usize) -> ([T; 3], [T; 4], [T; 3], T) {
        let c = &self.0;
        (
            [c[0][lane], c[1][lane], c[2][lane]],
            [c[3][lane], c[4][lane], c[5][lane], c[6][lane]],
            [c[7][lane], c[8][lane], c[9][lane]],
            c[10][lane],
        )
    }
}

/// Lanes to run for so many Gaussians.
#[inline(always)]
fn whole_vectors(len: usize) -> usize {
    len.next_multiple_of(LANES).min(PACKET_SIZE)
}

/// What projecting a packet needs besides its inputs and results. One thread uses it for one packet after the other:
/// whatever it holds, it is overwritten as far as it is read.
pub(crate) struct PacketScratch<T> {
    gaussians: Columns<T>,
    splats: [Column<T>; 7],
    outlines: [Column<T>; 6],
    counts: [Column<u32>; 5],
}

impl<T: Real> PacketScratch<T> {
    pub(crate) fn new() -> Self {
        Self {
            gaussians: Columns::new(),
            splats: [[T::ZERO; PACKET_SIZE]; 7],
            outlines: [[T::ZERO; PACKET_SIZE]; 6],
            counts: [[0; PACKET_SIZE]; 5],
        }
    }
}

/// Where the splats of a packet go.
pub(crate) struct PacketSplats<'a, T> {
    /// By Gaussian; of no meaning for one that no pixel sees.
    pub(crate) splats: &'a mut [Splat<T>],
    /// Camera z, likewise.
    pub(crate) depths: &'a mut [T],
    pub(crate) screen: ScreenInfo<'a, T>,
    pub(crate) cover: &'a mut Cover,
}

/// Projects the Gaussians from `first` on and finds the tiles that each reaches.
#[inline(always)]
pub(crate) fn project_packet<T: Real, const ANTIALIASED: bool>(
    gaussians: &Gaussians<'_, T>,
    channels: &Channels<'_, T>,
    first: usize,
    projection: &Projection<T>,
    grid: &TileGrid,
    wanted: Option<&[bool]>,
    scratch: &mut PacketScratch<T>,
    out: PacketSplats<'_, T>,
) {
    let len = out.splats.len();
    let projection = *projection;
    let PacketScratch {
        gaussians: columns,
        splats: [xs, ys, depths, w11s, w22s, slopes, log_opacities],
        outlines: [rxs, rys, padded, inverses, rights, half_heights],
        counts: [tops, bottoms, seen, ceil_xs, ceil_ys],
    } = scratch;
    for lane in 0..len.min(PACKET_SIZE) {
        columns.set(lane, gaussians, first + lane);
    }
    let (height, most) = (T::of(grid.height as f64), T::of(MOST_EXACT));
    // Tile sizes are powers of two; a division would cost more than all the rest.
    let shift = grid.tile_size.trailing_zeros();
    for lane in 0..whole_vectors(len) {
        let (mean, quat, scale, opacity) = columns.get(lane);
        let o = splat::<T, ANTIALIASED>(&projection, mean, quat, scale, opacity);
        let s = &o;
        (xs[lane], ys[lane], depths[lane]) = (s.x, s.y, s.depth);
        (w11s[lane], w22s[lane]) = (s.w11, s.w22);
        (slopes[lane], log_opacities[lane]) = (s.slope, s.log_opacity);
        [rxs[lane], rys[lane]] = o.radii;
        ceil_xs[lane] = o.radii[0].lesser(most).ceiling();
        ceil_ys[lane] = o.radii[1].lesser(most).ceiling();
        seen[lane] = u32::from(o.visible);

        let reach = padded_reach(o.reach);
        let extent = extent(reach);
        let (half_width, half_height) = (extent * o.deviations[0], extent * o.deviations[1]);
        padded[lane] = reach;
        inverses[lane] = T::ONE / s.w11;
        rights[lane] = s.tilt * half_width;
        half_heights[lane] = half_height;
        let (top, past) = pixel_range(s.y - half_height, s.y + half_height, height);
        let any = o.visible & (top < past);
        tops[lane] = top >> shift;
        bottoms[lane] = if any {
            (past.wrapping_sub(1) >> shift) + 1
        } else {
            0
        };
    }

    let ScreenInfo {
        means2d,
        depths: camera_zs,
        radii,
    } = out.screen;
    out.cover.clear(len);
    out.cover.visible = 0;
    let mut cutter = Cutter::new(grid, wanted);
    for lane in 0..len.min(PACKET_SIZE) {
        if seen[lane] == 0 {
            (means2d[lane], camera_zs[lane], radii[lane]) = ([T::ZERO; 2], T::ZERO, [0; 2]);
            continue;
        }
        out.cover.visible += 1;
        let (x, y, depth) = (xs[lane], ys[lane], depths[lane]);
        // Field by field: a splat made elsewhere would be copied.
        let splat = &mut out.splats[lane];
        (splat.x, splat.y) = (x, y);
        (splat.w11, splat.w22, splat.slope) = (w11s[lane], w22s[lane], slopes[lane]);
        (splat.right, splat.half_height) = (rights[lane], half_heights[lane]);
        splat.log_opacity = log_opacities[lane];
        channels.write_first(first + lane, depth, &mut splat.values);
        out.depths[lane] = depth;
        means2d[lane] = [x, y];
        camera_zs[lane] = depth;
        radii[lane] = [ceil_xs[lane] as i32, ceil_ys[lane] as i32];
        if rxs[lane].greater(rys[lane]) >= most {
            radii[lane] = huge_radii([rxs[lane], rys[lane]]);
        }
        let ellipse = Ellipse {
            x,
            y,
            reach: padded[lane],
            w22: w22s[lane],
            inverse_w11: inverses[lane],
            slope: slopes[lane],
            right: rights[lane],
            half_height: half_heights[lane],
        };
        cutter.push(lane, &ellipse, tops[lane]..bottoms[lane], out.cover);
    }
    cutter.flush(out.cover);
    out.cover.finish();
}

/// Radii beyond [`MOST_EXACT`]. The cast saturates: a Gaussian without bounds gets the largest integer. Apart, because the
/// compiler would work them out for every Gaussian.
#[cold]
#[inline(never)]
fn huge_radii<T: Real>(radii: [T; 2]) -> [i32; 2] {
    radii.map(|r| r.as_f64().ceil() as i32)
}

/// Gradients of the splats of a packet, packed: lane by lane those of the Gaussians that have any.
pub(crate) struct PacketGradients<T> {
    /// Which Gaussian of the packet is in each lane.
    locals: Column<u32>,
    /// How many.
    pub(crate) len: usize,
    /// h; hu, hv; huu, huv, hvv; camera z.
    moments: [Column<T>; 7],
    /// Of the Gaussians: mean, quaternion, scale, opacity; filled by [`packet_vjp`].
    gaussians: [Column<T>; 11],
    /// What [`packet_vjp`] needs besides: the Gaussians, and their gradients of the camera.
    inputs: Columns<T>,
    viewmats: [Column<T>; 12],
    /// Of the camera, summed over the packet, if asked for.
    pub(crate) viewmat: [[T; 4]; 3],
}

impl<T: Real> PacketGradients<T> {
    pub(crate) fn new() -> Self {
        Self {
            locals: [0; PACKET_SIZE],
            len: 0,
            moments: [[T::ZERO; PACKET_SIZE]; 7],
            gaussians: [[T::ZERO; PACKET_SIZE]; 11],
            inputs: Columns::new(),
            viewmats: [[T::ZERO; PACKET_SIZE]; 12],
            viewmat: [[T::ZERO; 4]; 3],
        }
    }

    /// Starts over. Columns keep what they hold: only the first `len` lanes of each mean anything.
    pub(crate) fn clear(&mut self) {
        self.len = 0;
        self.viewmat = [[T::ZERO; 4]; 3];
    }

    /// Adds a Gaussian of the packet with the gradients of its splat, unless all are zero.
    #[inline(always)]
    pub(crate) fn push(&mut self, local: usize, moments: [T; 7]) {
        if moments == [T::ZERO; 7] {
            return;
        }
        let lane = self.len;
        self.locals[lane] = local as u32;
        for (column, moment) in self.moments.iter_mut().zip(moments) {
            column[lane] = moment;
        }
        self.len += 1;
    }

    /// Adds the gradients of the Gaussians to those of the packet; an empty slice is one that nobody asked for.
    #[inline(always)]
    pub(crate) fn add_to(
        &self,
        means: &mut [[T; 3]],
        quats: &mut [[T; 4]],
        scales: &mut [[T; 3]],
        opacities: &mut [T],
    ) {
        let locals = &self.locals[..self.len.min(PACKET_SIZE)];
        let [m0, m1, m2, q0, q1, q2, q3, s0, s1, s2, o] = &self.gaussians;
        add(locals, [m0, m1, m2], means);
        add(locals, [q0, q1, q2, q3], quats);
        add(locals, [s0, s1, s2], scales);
        add(locals, [o], opacities.as_chunks_mut().0);
    }
}

#[inline(always)]
fn add<T: Real, const N: usize>(locals: &[u32], columns: [&Column<T>; N], sums: &mut [[T; N]]) {
    if sums.is_empty() {
        return;
    }
    for (lane, &local) in locals.iter().enumerate() {
        let sum = &mut sums[local as usize];
        for k in 0..N {
            sum[k] += columns[k][lane];
        }
    }
}

/// The sum of the first `len` values: lane by lane, then over the lanes, in the same order whatever the CPU's vectors.
#[inline(always)]
fn sum_of_lanes<T: Real>(column: &mut Column<T>, len: usize) -> T {
    column[len..whole_vectors(len)].fill(T::ZERO);
    let mut sums = [T::ZERO; LANES];
    for values in column[..whole_vectors(len)].as_chunks::<LANES>().0 {
        for i in 0..LANES {
            sums[i] += values[i];
        }
    }
    sums.into_iter().sum()
}

/// Whether all are finite: NaN and infinity survive a multiplication by 0.
#[inline(always)]
pub(crate) fn is_sound<T: Real, const N: usize>(values: [T; N]) -> bool {
    let mut sum = T::ZERO;
    for value in values {
        sum += value * T::ZERO;
    }
    sum == T::ZERO
}

/// The vjp of [`project_packet`], from splats to Gaussians and camera. A Gaussian whose gradient is beyond the scalar's
/// range, such as one at the camera's very place, has the gradient 0 and adds none to the camera's: an infinite one would
/// spoil the camera's gradient and an optimiser's averages.
#[inline(always)]
pub(crate) fn packet_vjp<T: Real, const ANTIALIASED: bool, const CAMERA: bool>(
    gaussians: &Gaussians<'_, T>,
    first: usize,
    projection: &Projection<T>,
    packet: &mut PacketGradients<T>,
) {
    let projection = *projection;
    let len = packet.len.min(PACKET_SIZE);
    let PacketGradients {
        locals,
        moments,
        gaussians: out,
        inputs,
        viewmats,
        viewmat,
        ..
    } = packet;
    for lane in 0..len {
        inputs.set(lane, gaussians, first + locals[lane] as usize);
    }
    for lane in 0..whole_vectors(len) {
        let (mean, quat, scale, opacity) = inputs.get(lane);
        let m = |k: usize| moments[k][lane];
        let [h, hu, hv, huu, huv, hvv, depth] = [m(0), m(1), m(2), m(3), m(4), m(5), m(6)];
        let v = SplatGradient {
            h,
            first: [hu, hv],
            second: [huu, huv, hvv],
            depth,
        };
        let v = splat_vjp::<T, ANTIALIASED>(&projection, mean, quat, scale, opacity, &v);
        // NaN in the incoming gradient is passed on, so that the caller notices it.
        let poisoned = !is_sound([h, hu, hv, huu, huv, hvv, depth]);
        let ([m0, m1, m2], [q0, q1, q2, q3], [s0, s1, s2]) = (v.mean, v.quat, v.scale);
        let own = [m0, m1, m2, q0, q1, q2, q3, s0, s1, s2, v.opacity];
        let kept = is_sound(own) | poisoned;
        for k in 0..11 {
            out[k][lane] = if kept { own[k] } else { T::ZERO };
        }
        if CAMERA {
            let [v0, v1, v2] = v.viewmat;
            let kept = kept & (is_sound(v0) & is_sound(v1) & is_sound(v2) | poisoned);
            for k in 0..12 {
                viewmats[k][lane] = if kept { v.viewmat[k / 4][k % 4] } else { T::ZERO };
            }
        }
    }
    if CAMERA {
        for (sum, column) in viewmat.as_flattened_mut().iter_mut().zip(viewmats) {
            *sum = sum_of_lanes(column, len);
        }
    }
}
