//! What it costs when fingers turn and bend as those of hands hardly do, back for gradients.

use bigs_raster::Real;

use crate::OpsError;
use crate::checks::check_length;

/// Joints of a hand's fingers, three to each: index, middle, pinky, ring and thumb.
pub const JOINTS: usize = 15;
/// Fingers whose two outer joints bend together: all but the thumb.
const FOLLOWING: usize = 4;
/// Linear functions that tell how far these bend: sines, then cosines, of the middle joints, then of the outermost.
const BENDS: usize = 4 * FOLLOWING;
/// Second differences across the hand, index to ring and middle to pinky.
const ACROSS: [[(usize, f64); 3]; 2] = [[(0, 1.0), (1, -2.0), (3, 1.0)], [(1, 1.0), (3, -2.0), (2, 1.0)]];
/// How far the outermost joint of a finger bends, of the joint before it: one tendon bends both.
const TOGETHER: f64 = 2.0 / 3.0;
/// Departures from that beyond this (radians) cost like themselves and not like their square.
const PRESSED: f64 = 0.15;

/// The fingers of a hand in B poses, and what is known of its joints.
#[derive(Clone, Copy, Debug)]
pub struct Fingers<'a, T> {
    /// B × 15 rotations, row by row.
    pub rotations: &'a [[T; 9]],
    /// M × 15 coefficients of linear functions of a pose, each the sine of a turn that a joint cannot make.
    pub impossible: &'a [[T; 9]],
    /// 16 × 15 coefficients: sines and cosines of the angles by which joints bend.
    pub bends: &'a [[T; 9]],
}

/// Means over the poses, or their gradients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Costs<T> {
    /// Of ‖R_a − 2 R_b + R_c‖² / 2 over the joints of three neighbouring fingers, square radians.
    pub unevenness: T,
    /// Of the squared sines of impossible turns.
    pub impossible: T,
    /// Of the departures of outermost joints from two thirds of the joints before them, square radians, pseudo-Huber.
    pub uncoupled: T,
}

/// A linear function of a pose: the joints that it depends on, and their coefficients.
type Form<'a, T> = Vec<(usize, &'a [T; 9])>;

fn forms<T: Real>(rows: &[[T; 9]]) -> Vec<Form<'_, T>> {
    let counts = |coefficients: &[T; 9]| coefficients.iter().any(|&c| c != T::ZERO);
    rows.chunks_exact(JOINTS)
        .map(|row| row.iter().enumerate().filter(|(_, c)| counts(c)).collect())
        .collect()
}

fn value<T: Real>(form: &Form<'_, T>, pose: &[[T; 9]]) -> T {
    let mut sum = T::ZERO;
    for &(joint, coefficients) in form {
        for (&c, &r) in coefficients.iter().zip(&pose[joint]) {
            sum += c * r;
        }
    }
    sum
}

fn add_form<T: Real>(form: &Form<'_, T>, pull: T, v_pose: &mut [[T; 9]]) {
    for &(joint, coefficients) in form {
        for (v, &c) in v_pose[joint].iter_mut().zip(coefficients) {
            *v += pull * c;
        }
    }
}

/// A second difference of the fingers' rotations at one of their three joints.
fn across<T: Real>(of: &[(usize, f64); 3], place: usize, pose: &[[T; 9]]) -> [T; 9] {
    std::array::from_fn(|i| {
        let mut sum = T::ZERO;
        for &(finger, factor) in of {
            sum += T::of(factor) * pose[3 * finger + place][i];
        }
        sum
    })
}

/// Sine and cosine of a joint's bend, and the angle.
struct Bend<T> {
    sine: T,
    cosine: T,
    angle: T,
}

impl<T: Real> Bend<T> {
    /// Of the middle joints, then of the outermost.
    fn all(forms: &[Form<'_, T>], pose: &[[T; 9]]) -> [Self; BENDS / 2] {
        std::array::from_fn(|i| {
            let (sine, cosine) = (value(&forms[i], pose), value(&forms[BENDS / 2 + i], pose));
            let angle = T::of(sine.as_f64().atan2(cosine.as_f64()));
            Self { sine, cosine, angle }
        })
    }

    /// Adds the pose's gradient from that of the angle.
    fn pull(&self, v: T, [sine, cosine]: [&Form<'_, T>; 2], v_pose: &mut [[T; 9]]) {
        let square = self.sine * self.sine + self.cosine * self.cosine;
        // Of two zeros there is no angle.
        if square != T::ZERO {
            add_form(sine, v * self.cosine / square, v_pose);
            add_form(cosine, -v * self.sine / square, v_pose);
        }
    }
}

/// A finger's departure from what its tendon makes, in units of `PRESSED`.
fn departure<T: Real>(bends: &[Bend<T>], finger: usize) -> T {
    let (middle, outer) = (bends[finger].angle, bends[FOLLOWING + finger].angle);
    (outer - T::of(TOGETHER) * middle) / T::of(PRESSED)
}

impl<T: Real> Fingers<'_, T> {
    /// Number of poses.
    fn poses(&self) -> Result<usize, OpsError> {
        let poses = self.rotations.len() / JOINTS;
        check_length("hand_pose", poses * JOINTS, self.rotations.len())?;
        let turns = self.impossible.len() / JOINTS;
        check_length("turns", turns * JOINTS, self.impossible.len())?;
        check_length("bends", BENDS * JOINTS, self.bends.len())?;
        Ok(poses)
    }

    /// What one of so many poses is worth in each mean.
    fn shares(&self, poses: usize) -> Costs<T> {
        let one = |each: f64, parts: usize| T::of(each / (poses * parts).max(1) as f64);
        Costs {
            unevenness: one(0.5, 2 * 3),
            impossible: one(1.0, self.impossible.len() / JOINTS),
            uncoupled: one(2.0 * PRESSED * PRESSED, FOLLOWING),
        }
    }

    /// The costs; 0 of no poses.
    ///
    /// # Errors
    /// A length that does not fit.
    pub fn costs(&self) -> Result<Costs<T>, OpsError> {
        let shares = self.shares(self.poses()?);
        let (impossible, bends) = (forms(self.impossible), forms(self.bends));
        let mut sums = Costs {
            unevenness: T::ZERO,
            impossible: T::ZERO,
            uncoupled: T::ZERO,
        };
        for pose in self.rotations.chunks_exact(JOINTS) {
            for of in &ACROSS {
                for place in 0..3 {
                    for bend in across(of, place, pose) {
                        sums.unevenness += bend * bend;
                    }
                }
            }
            for form in &impossible {
                let sine = value(form, pose);
                sums.impossible += sine * sine;
            }
            let bends = Bend::all(&bends, pose);
            for finger in 0..FOLLOWING {
                let away = departure(&bends, finger);
                sums.uncoupled += (T::ONE + away * away).sqrt() - T::ONE;
            }
        }
        Ok(Costs {
            unevenness: shares.unevenness * sums.unevenness,
            impossible: shares.impossible * sums.impossible,
            uncoupled: shares.uncoupled * sums.uncoupled,
        })
    }

    /// Gradients of the rotations from those of the costs.
    ///
    /// # Errors
    /// As [`Fingers::costs`].
    pub fn vjp(&self, v: Costs<T>) -> Result<Vec<[T; 9]>, OpsError> {
        let shares = self.shares(self.poses()?);
        let (impossible, bends) = (forms(self.impossible), forms(self.bends));
        let two = T::of(2.0);
        let mut out = vec![[T::ZERO; 9]; self.rotations.len()];
        for (pose, v_pose) in self
            .rotations
            .chunks_exact(JOINTS)
            .zip(out.chunks_exact_mut(JOINTS))
        {
            let pull = two * shares.unevenness * v.unevenness;
            for of in &ACROSS {
                for place in 0..3 {
                    let bend = across(of, place, pose);
                    for &(finger, factor) in of {
                        for (v, bend) in v_pose[3 * finger + place].iter_mut().zip(bend) {
                            *v += pull * T::of(factor) * bend;
                        }
                    }
                }
            }
            let pull = two * shares.impossible * v.impossible;
            for form in &impossible {
                add_form(form, pull * value(form, pose), v_pose);
            }
            let found = Bend::all(&bends, pose);
            for finger in 0..FOLLOWING {
                let away = departure(&found, finger);
                let pull =
                    shares.uncoupled * v.uncoupled * away / ((T::ONE + away * away).sqrt() * T::of(PRESSED));
                for (joint, pull) in [(finger, -T::of(TOGETHER) * pull), (FOLLOWING + finger, pull)] {
                    found[joint].pull(pull, [&bends[joint], &bends[BENDS / 2 + joint]], v_pose);
                }
            }
        }
        Ok(out)
    }
}
