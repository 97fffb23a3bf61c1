//! Sums of real spherical harmonics to degree 3, and their vjp.

use rayon::prelude::*;

use crate::color::basis::{basis, basis_vjp};
use crate::error::RasterError;
use crate::input::gaussians::{check_degree, check_length};
use crate::math::real::Real;
use crate::simd::level::{Simd, SimdLevel, Work};

/// Gaussians handled by one task. Fixed, so that sums do not depend on the number of threads.
const PACKET_SIZE: usize = 512;
/// Gaussians whose directions are worked on at once, in loops that vectorise.
const LANES: usize = 16;

/// A number for each of some Gaussians.
type Column<T> = [T; LANES];

/// Checked coefficients and directions of spherical harmonics; see [`crate::Harmonics`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct HarmonicSums<'a, T> {
    degree: usize,
    bases: usize,
    pub(crate) dirs: &'a [[T; 3]],
    pub(crate) coefficients: &'a [T],
    mask: Option<&'a [bool]>,
    level: SimdLevel,
}

/// Gradients of what [`crate::Harmonics`] was made of; empty if not asked for.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct HarmonicsGradients<T> {
    /// Of the directions, at right angles to each.
    pub dirs: Vec<[T; 3]>,
    /// Of the coefficients, summed over the places.
    pub coefficients: Vec<T>,
}

impl<'a, T: Real> HarmonicSums<'a, T> {
    /// See [`crate::Harmonics::new`].
    pub(crate) fn new(
        degree: usize,
        bases: usize,
        dirs: &'a [[T; 3]],
        coefficients: &'a [T],
        mask: Option<&'a [bool]>,
    ) -> Result<Self, RasterError> {
        check_degree(degree, bases)?;
        let n = coefficients.len() / (3 * bases);
        check_length("coefficients", n * 3 * bases, coefficients.len())?;
        let places = dirs.len().checked_div(n).unwrap_or(0);
        check_length("dirs", places * n, dirs.len())?;
        if let Some(mask) = mask {
            check_length("mask", dirs.len(), mask.len())?;
        }
        Ok(Self {
            degree,
            bases,
            dirs,
            coefficients,
            mask,
            level: SimdLevel::chosen()?,
        })
    }

    pub(crate) fn values(&self) -> Vec<[T; 3]> {
        match self.degree {
            0 => self.evaluate_bands::<1>(),
            1 => self.evaluate_bands::<4>(),
            2 => self.evaluate_bands::<9>(),
            _ => self.evaluate_bands::<16>(),
        }
    }

    pub(crate) fn add_vjp(&self, v_colors: &[[T; 3]], out: &mut HarmonicsGradients<T>) {
        match self.degree {
            0 => self.vjp_bands::<1>(v_colors, out),
            1 => self.vjp_bands::<4>(v_colors, out),
            2 => self.vjp_bands::<9>(v_colors, out),
            _ => self.vjp_bands::<16>(v_colors, out),
        }
    }

    fn gaussians(&self) -> usize {
        self.coefficients.len() / (3 * self.bases)
    }

    fn shown(&self, at: usize) -> bool {
        self.mask.is_none_or(|mask| mask[at])
    }

    fn rows<const B: usize>(&self, gaussian: usize) -> &[[T; 3]] {
        let own = &self.coefficients[gaussian * 3 * self.bases..][..3 * B];
        own.as_chunks().0
    }

    fn evaluate_bands<const B: usize>(&self) -> Vec<[T; 3]> {
        let mut colors = vec![[T::ZERO; 3]; self.dirs.len()];
        let pieces = by_packet(&mut colors, self.gaussians());
        pieces.into_par_iter().enumerate().for_each(|(packet, colors)| {
            self.level.run(Evaluate::<T, B> {
                sums: self,
                first: packet * PACKET_SIZE,
                colors,
            });
        });
        colors
    }

    fn vjp_bands<const B: usize>(&self, v_colors: &[[T; 3]], out: &mut HarmonicsGradients<T>) {
        let n = self.gaussians();
        let packets = n.div_ceil(PACKET_SIZE);
        let mut v_dirs = by_packet(&mut out.dirs, n);
        v_dirs.resize_with(packets, Vec::new);
        let mut v_coefficients: Vec<&mut [T]> = out
            .coefficients
            .chunks_mut(PACKET_SIZE * 3 * self.bases)
            .collect();
        v_coefficients.resize_with(packets, || &mut []);
        (v_dirs, v_coefficients).into_par_iter().enumerate().for_each(
            |(packet, (v_dirs, v_coefficients))| {
                self.level.run(Vjp::<T, B> {
                    sums: self,
                    v_colors,
                    first: packet * PACKET_SIZE,
                    v_dirs,
                    v_coefficients,
                });
            },
        );
    }
}

/// The colours of a packet of Gaussians, place by place.
struct Evaluate<'a, T, const B: usize> {
    sums: &'a HarmonicSums<'a, T>,
    first: usize,
    colors: Vec<&'a mut [[T; 3]]>,
}

impl<T: Real, const B: usize> Work for Evaluate<'_, T, B> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (sums, n) = (self.sums, self.sums.gaussians());
        for (place, colors) in self.colors.into_iter().enumerate() {
            for (part, colors) in colors.chunks_mut(LANES).enumerate() {
                let gaussian = self.first + part * LANES;
                let at = place * n + gaussian;
                let basis = basis_of::<T, B>(&Units::new(&sums.dirs[at..at + colors.len()]));
                for (lane, color) in colors.iter_mut().enumerate() {
                    if sums.shown(at + lane) {
                        let mut sum = [T::ZERO; 3];
                        for (column, row) in basis.iter().zip(sums.rows::<B>(gaussian + lane)) {
                            for c in 0..3 {
                                sum[c] += column[lane] * row[c];
                            }
                        }
                        *color = sum;
                    }
                }
            }
        }
    }
}

/// The gradients of a packet of Gaussians.
struct Vjp<'a, T, const B: usize> {
    sums: &'a HarmonicSums<'a, T>,
    v_colors: &'a [[T; 3]],
    first: usize,
    v_dirs: Vec<&'a mut [[T; 3]]>,
    v_coefficients: &'a mut [T],
}

impl<T: Real, const B: usize> Work for Vjp<'_, T, B> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self, _: S) {
        let (sums, n) = (self.sums, self.sums.gaussians());
        let places = sums.dirs.len().checked_div(n).unwrap_or(0);
        let end = (self.first + PACKET_SIZE).min(n);
        for gaussian in (self.first..end).step_by(LANES) {
            let (local, count) = (gaussian - self.first, LANES.min(end - gaussian));
            for place in 0..places {
                let at = place * n + gaussian;
                // A Gaussian that no pixel sees has no gradient, and its coefficients need not be read.
                let wanted: [bool; LANES] = std::array::from_fn(|lane| {
                    lane < count && sums.shown(at + lane) && self.v_colors[at + lane] != [T::ZERO; 3]
                });
                if !wanted.contains(&true) {
                    continue;
                }
                let units = Units::new(&sums.dirs[at..at + count]);
                if !self.v_coefficients.is_empty() {
                    let basis = basis_of::<T, B>(&units);
                    for lane in (0..count).filter(|&lane| wanted[lane]) {
                        let (v, own) = (self.v_colors[at + lane], (local + lane) * 3 * sums.bases);
                        let rows = self.v_coefficients[own..][..3 * B].as_chunks_mut::<3>().0;
                        for (column, row) in basis.iter().zip(rows) {
                            for c in 0..3 {
                                row[c] += column[lane] * v[c];
                            }
                        }
                    }
                }
                if let Some(v_dirs) = self.v_dirs.get_mut(place) {
                    let mut v_basis = [[T::ZERO; LANES]; B];
                    for lane in (0..count).filter(|&lane| wanted[lane]) {
                        let v = self.v_colors[at + lane];
                        for (column, row) in v_basis.iter_mut().zip(sums.rows::<B>(gaussian + lane)) {
                            column[lane] = row[0] * v[0] + row[1] * v[1] + row[2] * v[2];
                        }
                    }
                    let found = units.vjp(&v_basis);
                    for lane in (0..count).filter(|&lane| wanted[lane]) {
                        v_dirs[local + lane] = [found[0][lane], found[1][lane], found[2][lane]];
                    }
                }
            }
        }
    }
}

/// Directions of some vectors, and the reciprocals of their lengths; zeros for the zero vector.
struct Units<T> {
    axes: [Column<T>; 3],
    inverse_lengths: Column<T>,
}

impl<T: Real> Units<T> {
    #[inline(always)]
    fn new(vectors: &[[T; 3]]) -> Self {
        let mut axes = [[T::ZERO; LANES]; 3];
        for (lane, vector) in vectors.iter().enumerate().take(LANES) {
            for i in 0..3 {
                axes[i][lane] = vector[i];
            }
        }
        let mut inverse_lengths = [T::ZERO; LANES];
        for lane in 0..LANES {
            let v = [axes[0][lane], axes[1][lane], axes[2][lane]];
            // Divided by the largest part first, so that no square leaves the scalar's range.
            let largest = v[0].abs().greater(v[1].abs()).greater(v[2].abs());
            let none = largest == T::ZERO;
            let divisor = if none { T::ONE } else { largest };
            let v = [v[0] / divisor, v[1] / divisor, v[2] / divisor];
            let square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
            let inverse = T::ONE / (if none { T::ONE } else { square }).sqrt();
            for i in 0..3 {
                axes[i][lane] = v[i] * inverse;
            }
            inverse_lengths[lane] = if none { T::ZERO } else { inverse / largest };
        }
        Self {
            axes,
            inverse_lengths,
        }
    }

    #[inline(always)]
    fn at(&self, lane: usize) -> [T; 3] {
        [self.axes[0][lane], self.axes[1][lane], self.axes[2][lane]]
    }

    /// From gradients of the basis to those of the vectors, at right angles to each.
    #[inline(always)]
    fn vjp<const B: usize>(&self, v_basis: &[Column<T>; B]) -> [Column<T>; 3] {
        let mut out = [[T::ZERO; LANES]; 3];
        for lane in 0..LANES {
            let direction = self.at(lane);
            let v_unit = basis_vjp::<T, B>(direction, &std::array::from_fn(|b| v_basis[b][lane]));
            let radial = direction[0] * v_unit[0] + direction[1] * v_unit[1] + direction[2] * v_unit[2];
            for i in 0..3 {
                out[i][lane] = self.inverse_lengths[lane] * (v_unit[i] - direction[i] * radial);
            }
        }
        out
    }
}

/// The first B basis functions at some directions.
#[inline(always)]
fn basis_of<T: Real, const B: usize>(units: &Units<T>) -> [Column<T>; B] {
    let mut out = [[T::ZERO; LANES]; B];
    for lane in 0..LANES {
        let values = basis::<T, B>(units.at(lane));
        for b in 0..B {
            out[b][lane] = values[b];
        }
    }
    out
}

/// For each packet of Gaussians, its part of every place.
fn by_packet<U>(values: &mut [U], gaussians: usize) -> Vec<Vec<&mut [U]>> {
    if values.is_empty() {
        return Vec::new();
    }
    let places = values.len() / gaussians;
    let mut packets: Vec<Vec<&mut [U]>> = (0..gaussians.div_ceil(PACKET_SIZE))
        .map(|_| Vec::with_capacity(places))
        .collect();
    for place in values.chunks_exact_mut(gaussians) {
        for (packet, part) in packets.iter_mut().zip(place.chunks_mut(PACKET_SIZE)) {
            packet.push(part);
        }
    }
    packets
}
