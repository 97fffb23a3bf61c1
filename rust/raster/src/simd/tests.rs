//! Every vector type of this machine against plain floats.

use super::portable::Portable;
use super::*;
use crate::simd::level::{SimdLevel, Work};
use crate::simd::vector::*;

/// Calls a generic function with the vectors of every level that this machine has, and with the portable ones.
macro_rules! for_all_vectors {
    ($check:ident) => {
        struct Check;
        impl Work for Check {
            type Output = ();
            fn run<S: Simd>(self, simd: S) {
                $check::<S::F32>(simd);
                $check::<S::F64>(simd);
            }
        }
        Portable::guaranteed().run(Check);
        for level in SimdLevel::available() {
            level.run(Check);
        }
    };
}

fn vector<V: Vector>(level: V::Level, value: impl Fn(usize) -> f64) -> V {
    let values: Vec<V::Scalar> = (0..V::LANES).map(|i| V::Scalar::of(value(i))).collect();
    V::load(level, &values)
}

fn lanes<V: Vector>(v: V) -> Vec<f64> {
    let mut values = vec![V::Scalar::ZERO; V::LANES];
    v.store(&mut values);
    values.iter().map(|v| v.as_f64()).collect()
}

/// The distance from 1 to the next float.
fn epsilon<V: Vector>() -> f64 {
    if size_of::<V::Scalar>() == 4 {
        f64::from(f32::EPSILON)
    } else {
        f64::EPSILON
    }
}

fn arithmetic<V: Vector>(level: V::Level) {
    let a = vector::<V>(level, |i| i as f64 + 1.0);
    let b = vector::<V>(level, |i| 3.0 - i as f64 * 0.5);
    let c = V::splat(level, V::Scalar::of(0.25));
    let expect = |got: V, f: &dyn Fn(f64, f64) -> f64| {
        for (i, got) in lanes(got).into_iter().enumerate() {
            let exact = f(i as f64 + 1.0, 3.0 - i as f64 * 0.5);
            assert!(
                (got - exact).abs() <= epsilon::<V>() * exact.abs(),
                "lane {i}: {got} against {exact}"
            );
        }
    };
    expect(a.plus(b), &|a, b| a + b);
    expect(a.minus(b), &|a, b| a - b);
    expect(a.times(b), &|a, b| a * b);
    expect(b.over(a), &|a, b| b / a);
    expect(a.times_plus(b, c), &|a, b| a * b + 0.25);
    expect(a.times_minus(b, c), &|a, b| a * b - 0.25);
    expect(a.times_from(b, c), &|a, b| 0.25 - a * b);
    expect(a.minus_times_minus(b, c), &|a, b| -(a * b) - 0.25);
    expect(a.min(b), &f64::min);
    expect(a.max(b), &f64::max);
    expect(a.select(a.above(b), c), &|a, b| if a > b { a } else { 0.25 });
    expect(a.keep(a.at_least(b)), &|a, b| if a >= b { a } else { 0.0 });
    expect(a.keep(V::both(a.above(b), c.at_least(b))), &|a, b| {
        if a > b && b <= 0.25 { a } else { 0.0 }
    });
    let bits = (0..V::LANES).fold(0, |bits, i| {
        bits | u32::from(i as f64 + 1.0 > 3.0 - i as f64 * 0.5) << i
    });
    assert_eq!(V::bits(a.above(b)), bits);
    let nan = V::splat(level, V::Scalar::of(f64::NAN));
    assert_eq!(V::bits(nan.at_least(a)) | V::bits(a.above(nan)), 0);
    assert_eq!(lanes(nan.min(a)), lanes(a));
    assert_eq!(lanes(nan.max(a)), lanes(a));
}

#[test]
fn arithmetic_is_that_of_floats() {
    for_all_vectors!(arithmetic);
}

/// Powers by a polynomial of DEGREE are that precise, relatively.
fn powers_to<V: Vector, const DEGREE: usize>(level: V::Level, precision: f64) {
    // Miri takes milliseconds for each.
    for step in (0..40_000).step_by(if cfg!(miri) { 10_000 } else { 1 }) {
        // The values as the scalar has them, so that only the power's own error counts.
        let x = vector::<V>(level, |i| -(f64::from(step) + i as f64 / 16.0) * 0.003);
        for (x, power) in lanes(x).into_iter().zip(lanes(x.exp2::<DEGREE>())) {
            let exact = x.exp2();
            assert!(
                (power - exact).abs() <= precision * exact,
                "2^{x}: {power} against {exact}"
            );
        }
    }
    assert_eq!(
        lanes(V::splat(level, V::Scalar::ZERO).exp2::<DEGREE>()),
        vec![1.0; V::LANES]
    );
    for far in [-1100.0, -1e9, f64::NEG_INFINITY] {
        let power = lanes(V::splat(level, V::Scalar::of(far)).exp2::<DEGREE>());
        assert!(power.iter().all(|&p| (0.0..2e-38).contains(&p)), "{power:?}");
    }
}

fn powers<V: Vector>(level: V::Level) {
    // Under Miri the library's own powers, with which these are compared, are off by some last bits, chosen at random.
    let slack = if cfg!(miri) { 16.0 * f64::EPSILON } else { 0.0 };
    powers_to::<V, 5>(level, 3.0 * epsilon::<V>() + slack);
}

#[test]
fn exp2_is_right_to_the_last_bits() {
    for_all_vectors!(powers);
}

fn rough_powers<V: Vector>(level: V::Level) {
    powers_to::<V, 4>(level, 3.3e-6);
    powers_to::<V, 3>(level, 1.05e-4);
}

#[test]
fn exp2_is_as_right_as_its_degree() {
    for_all_vectors!(rough_powers);
}

fn quotients<V: Vector>(level: V::Level) {
    for step in (1..=10_000).step_by(if cfg!(miri) { 5000 } else { 1 }) {
        let divisor = vector::<V>(level, |i| (f64::from(step) - i as f64 / 32.0) * 1e-4);
        let dividend = V::splat(level, V::Scalar::of(1.0 / 3.0));
        for (d, q) in lanes(divisor).into_iter().zip(lanes(dividend.over(divisor))) {
            let exact = V::Scalar::of(1.0 / 3.0).as_f64() / d;
            assert!((q / exact - 1.0).abs() <= epsilon::<V>(), "1/3 / {d}: {q}");
        }
    }
}

#[test]
fn quotients_are_right_to_the_last_bit() {
    for_all_vectors!(quotients);
}

fn sums<V: Vector>(level: V::Level) {
    let vectors: [V; 9] = std::array::from_fn(|n| vector(level, |i| (n * 100 + i) as f64));
    let sums = V::sums(&vectors);
    for (n, sum) in sums[..9].iter().enumerate() {
        let exact: usize = (0..V::LANES).map(|i| n * 100 + i).sum();
        assert_eq!(sum.as_f64(), exact as f64);
    }
    // The place of a vector among others must not matter to its sum.
    let rough = vector::<V>(level, |i| 1.0 / (i as f64 + 0.7));
    let equal = V::sums(&[rough; 14]);
    assert!(equal[..14].iter().all(|&sum| sum == equal[0]));
}

#[test]
fn sums_are_of_lanes() {
    for_all_vectors!(sums);
}

#[test]
fn bits_are_transposed() {
    let rows: [u64; 64] = std::array::from_fn(|i| (i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    let mut columns = rows;
    transpose_bits(&mut columns);
    for (b, column) in columns.iter().enumerate() {
        for (i, row) in rows.iter().enumerate() {
            assert_eq!(column >> i & 1, row >> b & 1, "row {i}, bit {b}");
        }
    }
}
