//! Sums of real spherical harmonics to degree 3, and their vjp.

use rayon::prelude::*;

use crate::color::basis::{basis, basis_vjp};
use crate::error::RasterError;
use crate::input::gaussians::{check_degree, check_length};
use crate::math::real::Real;

/// Gaussians handled by one task. Fixed, so that sums do not depend on the number of threads.
const PACKET_SIZE: usize = 512;

/// Checked coefficients and directions of spherical harmonics; see [`crate::Harmonics`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct HarmonicSums<'a, T> {
    degree: usize,
    bases: usize,
    pub(crate) dirs: &'a [[T; 3]],
    pub(crate) coefficients: &'a [T],
    mask: Option<&'a [bool]>,
}

/// Gradients of what [`crate::Harmonics`] was made of; empty if not asked for.
#[derive(Clone, Debug, PartialEq)]
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
        let n = self.gaussians();
        let mut colors = vec![[T::ZERO; 3]; self.dirs.len()];
        let pieces = by_packet(&mut colors, n);
        pieces.into_par_iter().enumerate().for_each(|(packet, places)| {
            for (place, colors) in places.into_iter().enumerate() {
                for (local, color) in colors.iter_mut().enumerate() {
                    let gaussian = packet * PACKET_SIZE + local;
                    let at = place * n + gaussian;
                    if self.shown(at) {
                        let basis = basis::<T, B>(unit(self.dirs[at]).0);
                        for (b, row) in basis.iter().zip(self.rows::<B>(gaussian)) {
                            for c in 0..3 {
                                color[c] += *b * row[c];
                            }
                        }
                    }
                }
            }
        });
        colors
    }

    fn vjp_bands<const B: usize>(&self, v_colors: &[[T; 3]], out: &mut HarmonicsGradients<T>) {
        let n = self.gaussians();
        let packets = n.div_ceil(PACKET_SIZE);
        let places = self.dirs.len().checked_div(n).unwrap_or(0);
        let mut v_dirs = by_packet(&mut out.dirs, n);
        v_dirs.resize_with(packets, Vec::new);
        let mut v_coefficients: Vec<&mut [T]> = out
            .coefficients
            .chunks_mut(PACKET_SIZE * 3 * self.bases)
            .collect();
        v_coefficients.resize_with(packets, || &mut []);
        (v_dirs, v_coefficients).into_par_iter().enumerate().for_each(
            |(packet, (mut v_dirs, v_coefficients))| {
                let first = packet * PACKET_SIZE;
                for gaussian in first..(first + PACKET_SIZE).min(n) {
                    let local = gaussian - first;
                    let rows = self.rows::<B>(gaussian);
                    for place in 0..places {
                        let at = place * n + gaussian;
                        let v = v_colors[at];
                        // A Gaussian that no pixel sees has no gradient, and its coefficients need not be read.
                        if !self.shown(at) || v == [T::ZERO; 3] {
                            continue;
                        }
                        let (direction, inverse_length) = unit(self.dirs[at]);
                        if let Some(sums) = v_coefficients.get_mut(local * 3 * self.bases..) {
                            let basis = basis::<T, B>(direction);
                            for (b, sums) in basis.iter().zip(sums.as_chunks_mut::<3>().0) {
                                for c in 0..3 {
                                    sums[c] += *b * v[c];
                                }
                            }
                        }
                        if let Some(v_dirs) = v_dirs.get_mut(place) {
                            let mut v_basis = [T::ZERO; B];
                            for (v_b, row) in v_basis.iter_mut().zip(rows) {
                                *v_b = row[0] * v[0] + row[1] * v[1] + row[2] * v[2];
                            }
                            let v_unit = basis_vjp(direction, &v_basis);
                            let radial = direction[0] * v_unit[0]
                                + direction[1] * v_unit[1]
                                + direction[2] * v_unit[2];
                            v_dirs[local] =
                                [0, 1, 2].map(|i| inverse_length * (v_unit[i] - direction[i] * radial));
                        }
                    }
                }
            },
        );
    }
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

/// The direction of a vector and the reciprocal of its length; zeros for the zero vector.
#[inline(always)]
fn unit<T: Real>(v: [T; 3]) -> ([T; 3], T) {
    // Divided by the largest part first, so that no square leaves the scalar's range.
    let largest = v[0].abs().greater(v[1].abs()).greater(v[2].abs());
    if largest == T::ZERO {
        return ([T::ZERO; 3], T::ZERO);
    }
    let v = v.map(|x| x / largest);
    let inverse = T::ONE / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    (v.map(|x| x * inverse), inverse / largest)
}
