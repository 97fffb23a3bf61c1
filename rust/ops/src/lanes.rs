//! A vector of the CPU's level with the operators of arithmetic, so that kernels read as their formulas do.

use std::ops::{Add, Mul, Neg, Sub};

use bigs_raster::{Real, Simd, Vector, Vectors};

/// The longest vector there is, of any level and scalar.
pub(crate) const LONGEST: usize = 16;

/// A vector of scalars `T` at the level `S`.
pub(crate) struct Lanes<T: Vectors, S: Simd>(T::In<S>);

impl<T: Vectors, S: Simd> Clone for Lanes<T, S> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<T: Vectors, S: Simd> Copy for Lanes<T, S> {}

impl<T: Vectors, S: Simd> Lanes<T, S> {
    pub(crate) const COUNT: usize = <T::In<S> as Vector>::LANES;

    #[inline(always)]
    pub(crate) fn splat(simd: S, value: T) -> Self {
        Self(T::In::<S>::splat(simd, value))
    }

    #[inline(always)]
    pub(crate) fn zero(simd: S) -> Self {
        Self::splat(simd, T::ZERO)
    }

    #[inline(always)]
    pub(crate) fn load(simd: S, values: &[T]) -> Self {
        Self(T::In::<S>::load(simd, values))
    }

    #[inline(always)]
    pub(crate) fn store(self, values: &mut [T]) {
        self.0.store(values);
    }

    /// self · a + b
    #[inline(always)]
    pub(crate) fn times_plus(self, a: Self, b: Self) -> Self {
        Self(self.0.times_plus(a.0, b.0))
    }

    #[inline(always)]
    pub(crate) fn over(self, other: Self) -> Self {
        Self(self.0.over(other.0))
    }

    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        Self(self.0.max(other.0))
    }

    /// self where a > b, else `other`
    #[inline(always)]
    pub(crate) fn where_above(self, a: Self, b: Self, other: Self) -> Self {
        Self(self.0.select(a.0.above(b.0), other.0))
    }

    /// eˣ, and NaN for NaN.
    #[inline(always)]
    pub(crate) fn exp(self, simd: S) -> Self {
        let log2e = Self::splat(simd, T::of(std::f64::consts::LOG2_E));
        // Below, the vector's power of two is exact for what is at most 0; beyond the range of numbers it is 0.
        let falling = Self((self.max(-self) * -log2e).0.exp2::<5>());
        let one = Self::splat(simd, T::ONE);
        let value = one.over(falling).where_above(self, Self::zero(simd), falling);
        // A comparison with NaN is false, and the power's rounding would hide it.
        let nothing = self * Self::zero(simd);
        value + nothing
    }

    /// Sums over the lanes of each of N vectors.
    #[inline(always)]
    pub(crate) fn sums<const N: usize>(vectors: &[Self; N]) -> [T; N] {
        let mut sums = [T::ZERO; N];
        let mut bare = [vectors[0].0; N];
        for i in 0..N {
            bare[i] = vectors[i].0;
        }
        sums.copy_from_slice(&T::In::<S>::sums(&bare)[..N]);
        sums
    }
}

impl<T: Vectors, S: Simd> Add for Lanes<T, S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(self.0.plus(other.0))
    }
}

impl<T: Vectors, S: Simd> Sub for Lanes<T, S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(self.0.minus(other.0))
    }
}

impl<T: Vectors, S: Simd> Mul for Lanes<T, S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(self.0.times(other.0))
    }
}

impl<T: Vectors, S: Simd> Neg for Lanes<T, S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        let zero = T::In::<S>::splat(self.0.level(), T::ZERO);
        Self(zero.minus(self.0))
    }
}

/// A quaternion w x y z, or any four.
pub(crate) type Four<L> = [L; 4];

/// The Hamilton product.
#[inline(always)]
pub(crate) fn product<L>([aw, ax, ay, az]: Four<L>, [bw, bx, by, bz]: Four<L>) -> Four<L>
where
    L: Copy + Add<Output = L> + Sub<Output = L> + Mul<Output = L>,
{
    [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
}

#[inline(always)]
pub(crate) fn conjugate<L: Copy + Neg<Output = L>>([w, x, y, z]: Four<L>) -> Four<L> {
    [w, -x, -y, -z]
}

/// The value in a scalar that a formula names by its decimal form.
#[inline(always)]
pub(crate) fn of<T: Real>(value: f64) -> T {
    T::of(value)
}
