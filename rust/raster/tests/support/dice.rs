//! Random numbers, ordinary and wild.

use bigs_raster::Scalar;

/// splitmix64: every seed is a good one.
pub struct Dice {
    state: u64,
    /// What is thrown first.
    loaded: Vec<u8>,
}

impl Dice {
    pub fn new(seed: u64) -> Self {
        Self {
            state: seed,
            loaded: Vec::new(),
        }
    }

    /// Dice that throw these bytes, one each, and then numbers of seed 0: for a fuzzer, which changes single throws.
    pub fn of_bytes(bytes: &[u8]) -> Self {
        Self {
            state: 0,
            loaded: bytes.iter().rev().copied().collect(),
        }
    }

    pub fn bits(&mut self) -> u64 {
        if let Some(byte) = self.loaded.pop() {
            // In the low bits for `below`, in the high ones for `uniform`.
            return u64::from(byte) * 0x0101_0101_0101_0101;
        }
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// One of `0..count`.
    pub fn below(&mut self, count: usize) -> usize {
        (self.bits() % count as u64) as usize
    }

    /// True once in `times`.
    pub fn once_in(&mut self, times: usize) -> bool {
        self.below(times) == 0
    }

    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// How far numbers stray from what scenes are made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wildness {
    /// Ordinary scenes.
    Tame,
    /// Every magnitude that a scene in odd units may have: 1e-6 to 1e6.
    Stretched,
    /// Any finite number: zeros, denormals, the largest.
    Finite,
    /// Any bits at all: NaN and infinity too.
    Bits,
}

/// A number near `usual`, or not.
pub fn number(dice: &mut Dice, wildness: Wildness, low: f64, high: f64) -> f64 {
    let usual = dice.uniform(low, high);
    if wildness == Wildness::Tame || !dice.once_in(6) {
        return usual;
    }
    let sign = if dice.once_in(2) { -1.0 } else { 1.0 };
    if wildness == Wildness::Stretched {
        return match dice.below(6) {
            0 => 0.0,
            1 => -usual,
            _ => usual * 10f64.powf(dice.uniform(-6.0, 6.0)),
        };
    }
    match dice.below(if wildness == Wildness::Bits { 12 } else { 9 }) {
        0 => 0.0,
        1 => -0.0,
        2 => sign * 10f64.powf(dice.uniform(-45.0, -30.0)),
        3 => sign * 10f64.powf(dice.uniform(30.0, 38.5)),
        4 => sign * 10f64.powf(dice.uniform(-30.0, 30.0)),
        5 => sign * f64::from(f32::MIN_POSITIVE),
        6 => sign * f64::from(f32::MAX),
        7 => usual.round(),
        8 => 1.0 / 255.0,
        9 => f64::NAN,
        10 => sign * f64::INFINITY,
        _ => f64::from(f32::from_bits(dice.bits() as u32)),
    }
}

/// A number of the scalar; what only overflows on the way to it is brought back, unless bits are wanted.
pub fn scalar<T: Scalar>(dice: &mut Dice, wildness: Wildness, low: f64, high: f64) -> T {
    let value = T::of(number(dice, wildness, low, high));
    if wildness != Wildness::Bits && !value.is_finite() {
        T::of(usual_middle(low, high))
    } else {
        value
    }
}

fn usual_middle(low: f64, high: f64) -> f64 {
    0.5 * (low + high)
}
