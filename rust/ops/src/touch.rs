//! How far a hand reaches towards an object that moves, and how deep into it.
//!
//! Hardly any vertex of a hand touches: of all others only the distance is computed, and gradients leave them out.

use bigs_raster::Vectors;
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;
use crate::distance::{Grid, Sampler};
use crate::groups::{Deepest, Group, MOST_GROUPS};
use crate::mat3::add;
use crate::pose::{Pose, Subject};

/// An object's surface and its pose in each of B frames: x = scale · R p + centre.
#[derive(Clone, Copy, Debug)]
pub struct Object<'a, T> {
    /// Distances in the object's own frame.
    pub grid: Grid<'a, T>,
    /// B rotations, row by row.
    pub rotations: &'a [[T; 9]],
    /// B.
    pub centers: &'a [[T; 3]],
    /// For the whole clip.
    pub scale: T,
}

/// A hand beside an object in B frames.
#[derive(Debug)]
pub struct Touch<'a, T> {
    hand: Subject<'a, T>,
    /// The same in all frames.
    pose: Pose<'a, T>,
    object: Object<'a, T>,
    /// 1 / scale.
    per_scale: T,
    groups: Vec<Deepest>,
    tolerance: T,
    frames: usize,
}

/// What touches, and what gradients need.
#[derive(Clone, Debug, PartialEq)]
pub struct Touched<T> {
    /// B × G: the mean of the least signed distances of each group, in the unit of the points.
    pub depths: Vec<T>,
    /// B: the sum over vertices of squared depths below the tolerance.
    pub sunk: Vec<T>,
    counted: Vec<Vec<Counted<T>>>,
}

/// A vertex that counts in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Counted<T> {
    vertex: usize,
    point: [T; 3],
    distance: T,
    /// The groups, bit by bit, of whose deepest it is one.
    groups: u32,
}

/// Gradients of all inputs but weights and grid.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct TouchGradients<T> {
    pub points: Vec<[T; 3]>,
    /// As long as the hand's.
    pub bones: Vec<T>,
    pub rotations: Vec<[T; 9]>,
    pub centers: Vec<[T; 3]>,
    pub scale: T,
}

/// One frame's share of the gradients.
struct FrameGradients<T> {
    points: Vec<(usize, [T; 3])>,
    bones: Vec<T>,
    rotation: [T; 9],
    center: [T; 3],
    scale: T,
}

impl<'a, T: Vectors> Touch<'a, T> {
    /// Checks lengths.
    ///
    /// * `hand`: its vertices; a surface is not looked at
    /// * `groups`: what of it is to reach the surface, at most 32
    /// * `tolerance`: depth that does not count as sunk
    ///
    /// # Errors
    /// A length that does not fit, or groups that are too many, are empty or name vertices that there are not.
    pub fn new(
        hand: Subject<'a, T>,
        object: Object<'a, T>,
        groups: &[Group],
        tolerance: T,
    ) -> Result<Self, OpsError> {
        let frames = object.centers.len();
        check_length("rotations", frames, object.rotations.len())?;
        if groups.len() > MOST_GROUPS {
            return Err(OpsError::BadSize {
                name: "groups",
                expected: "at most 32",
                got: groups.len(),
            });
        }
        let groups = groups
            .iter()
            .map(|group| Deepest::of(group, hand.count))
            .collect::<Result<_, _>>()?;
        let hand = Subject {
            surface: None,
            ..hand
        };
        Ok(Self {
            hand,
            pose: Pose::new(frames, vec![hand], None, false)?,
            object,
            per_scale: T::ONE / object.scale,
            groups,
            tolerance,
            frames,
        })
    }

    /// What touches in every frame.
    ///
    /// # Errors
    /// A length that does not fit, a grid without room between its values, or a level that this machine does not have.
    pub fn measure(&self) -> Result<Touched<T>, OpsError> {
        let points = self.pose.forward()?.means;
        let sampler = self.object.grid.sampler()?;
        let each: Vec<(Vec<T>, T, Vec<Counted<T>>)> = points
            .par_chunks_exact(self.hand.count)
            .enumerate()
            .map(|(frame, points)| self.frame(frame, points, &sampler))
            .collect();
        let mut out = Touched {
            depths: Vec::with_capacity(self.frames * self.groups.len()),
            sunk: Vec::with_capacity(self.frames),
            counted: Vec::with_capacity(self.frames),
        };
        for (depths, sunk, counted) in each {
            out.depths.extend(depths);
            out.sunk.push(sunk);
            out.counted.push(counted);
        }
        Ok(out)
    }

    fn frame(
        &self,
        frame: usize,
        points: &[[T; 3]],
        sampler: &Sampler<'_, T>,
    ) -> (Vec<T>, T, Vec<Counted<T>>) {
        let distances: Vec<T> = points
            .iter()
            .map(|&point| self.object.scale * sampler.distance(self.own(frame, point)))
            .collect();
        let mut among = vec![0_u32; points.len()];
        let depths = self
            .groups
            .iter()
            .enumerate()
            .map(|(g, group)| group.mark(&distances, &mut among, 1 << g))
            .collect();
        let mut sunk = T::ZERO;
        let mut counted = Vec::new();
        for (vertex, (&point, &distance)) in points.iter().zip(&distances).enumerate() {
            let depth = self.depth(distance);
            // True of a depth that is not a number, so that it shows in the sum.
            if depth != T::ZERO {
                sunk += depth * depth;
            }
            let groups = among[vertex];
            if groups != 0 || depth != T::ZERO {
                counted.push(Counted {
                    vertex,
                    point,
                    distance,
                    groups,
                });
            }
        }
        (depths, sunk, counted)
    }

    /// How much further than the tolerance a distance is inside; 0 outside.
    fn depth(&self, distance: T) -> T {
        let depth = -distance - self.tolerance;
        if depth < T::ZERO { T::ZERO } else { depth }
    }

    /// A point of a frame in the object's frame.
    fn own(&self, frame: usize, point: [T; 3]) -> [T; 3] {
        let (r, c) = (&self.object.rotations[frame], &self.object.centers[frame]);
        let away = [0, 1, 2].map(|i| point[i] - c[i]);
        [0, 1, 2].map(|j| (r[j] * away[0] + r[3 + j] * away[1] + r[6 + j] * away[2]) * self.per_scale)
    }

    /// Gradients from those of the depths and of what is sunk, `None` for zeros.
    ///
    /// # Errors
    /// As [`Touch::measure`], and gradients or measures of another length.
    pub fn vjp(
        &self,
        touched: &Touched<T>,
        v_depths: Option<&[T]>,
        v_sunk: Option<&[T]>,
    ) -> Result<TouchGradients<T>, OpsError> {
        let count = self.groups.len();
        let depths = self.frames * count;
        check_length("v_depths", depths, v_depths.map_or(depths, <[_]>::len))?;
        check_length("v_sunk", self.frames, v_sunk.map_or(self.frames, <[_]>::len))?;
        check_length("depths", self.frames, touched.counted.len())?;
        let sampler = self.object.grid.sampler()?;
        let each: Vec<FrameGradients<T>> = touched
            .counted
            .par_iter()
            .enumerate()
            .map(|(frame, counted)| {
                let v_depths = v_depths.map_or(&[][..], |v| &v[frame * count..][..count]);
                let v_sunk = v_sunk.map_or(T::ZERO, |v| v[frame]);
                let pulls = counted.iter().map(|at| {
                    let mut pull = T::of(-2.0) * v_sunk * self.depth(at.distance);
                    for (g, (&v, group)) in v_depths.iter().zip(&self.groups).enumerate() {
                        if at.groups >> g & 1 == 1 {
                            pull += v / T::of(group.count as f64);
                        }
                    }
                    (at, pull)
                });
                self.frame_vjp(frame, pulls, &sampler)
            })
            .collect();
        let moves = self.hand.points.len() != self.hand.count;
        let mut out = TouchGradients {
            points: vec![[T::ZERO; 3]; self.hand.points.len()],
            bones: Vec::with_capacity(self.hand.bones.len()),
            rotations: Vec::with_capacity(self.frames),
            centers: Vec::with_capacity(self.frames),
            scale: T::ZERO,
        };
        for (frame, own) in each.into_iter().enumerate() {
            let first = if moves { frame * self.hand.count } else { 0 };
            for (vertex, v) in own.points {
                add(&mut out.points[first + vertex], v);
            }
            out.bones.extend(own.bones);
            out.rotations.push(own.rotation);
            out.centers.push(own.center);
            out.scale += own.scale;
        }
        Ok(out)
    }

    fn frame_vjp<'c>(
        &self,
        frame: usize,
        pulls: impl Iterator<Item = (&'c Counted<T>, T)>,
        sampler: &Sampler<'_, T>,
    ) -> FrameGradients<T> {
        let count = self.hand.weights.len() / self.hand.count;
        let size = self.hand.bone_size;
        let bones = &self.hand.bones[frame * count * size..][..count * size];
        let moves = self.hand.points.len() != self.hand.count;
        let first = if moves { frame * self.hand.count } else { 0 };
        let (rotation, scale) = (&self.object.rotations[frame], self.object.scale);
        let mut out = FrameGradients {
            points: Vec::new(),
            bones: vec![T::ZERO; count * size],
            rotation: [T::ZERO; 9],
            center: [T::ZERO; 3],
            scale: T::ZERO,
        };
        for (at, v) in pulls.filter(|&(_, v)| v != T::ZERO) {
            let own = self.own(frame, at.point);
            // scale · slope / scale: of the point turned into the object's frame.
            let pull = sampler.sample(own).1.map(|slope| v * slope);
            out.scale += v * at.distance / scale - (pull[0] * own[0] + pull[1] * own[1] + pull[2] * own[2]);
            let mut v_point = [T::ZERO; 3];
            for i in 0..3 {
                let row = &rotation[3 * i..][..3];
                v_point[i] = row[0] * pull[0] + row[1] * pull[1] + row[2] * pull[2];
                out.center[i] += -v_point[i];
                for j in 0..3 {
                    out.rotation[3 * i + j] += (at.point[i] - self.object.centers[frame][i]) * pull[j];
                }
            }
            if self.hand.mirrored {
                v_point[0] = -v_point[0];
            }
            let rest = self.hand.points[first + at.vertex];
            let mut v_rest = [T::ZERO; 3];
            for (k, &weight) in self.hand.weights[at.vertex * count..][..count].iter().enumerate() {
                let (bone, v_bone) = (&bones[k * size..], &mut out.bones[k * size..][..size]);
                for i in 0..3 {
                    let v = weight * v_point[i];
                    for j in 0..3 {
                        v_rest[j] += v * bone[4 * i + j];
                        v_bone[4 * i + j] += v * rest[j];
                    }
                    v_bone[4 * i + 3] += v;
                }
            }
            out.points.push((at.vertex, v_rest));
        }
        out
    }
}
