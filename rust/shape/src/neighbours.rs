//! The nearest of many points for each of many places.

use rayon::prelude::*;

use crate::nearest::{Nearest, squared_distance};
use crate::{ShapeError, Vec3};

/// Places that a thread takes at a time.
const CHUNK: usize = 256;

/// Points among which the nearest are sought, any number of times.
#[derive(Clone, Debug)]
pub struct Neighbours {
    points: Vec<Vec3>,
    tree: Nearest,
}

impl Neighbours {
    /// # Errors
    /// No points.
    pub fn new(points: Vec<Vec3>) -> Result<Self, ShapeError> {
        if points.is_empty() {
            return Err(ShapeError::none("points"));
        }
        let tree = Nearest::new(&points);
        Ok(Self { points, tree })
    }

    /// Distance and index of the point that is nearest to each place; of those equally near, any one. A place that is not
    /// finite has an infinite distance.
    ///
    /// A guess of each index, such as that of a place nearby, saves time and changes nothing else.
    ///
    /// # Errors
    /// Another number of guesses than of places, or one that is no index.
    pub fn of(&self, places: &[Vec3], guesses: Option<&[u32]>) -> Result<(Vec<f64>, Vec<u32>), ShapeError> {
        if let Some(guesses) = guesses {
            ShapeError::check("guesses", places.len(), guesses.len())?;
            ShapeError::check_indices("guesses", self.points.len(), guesses)?;
        }
        let (mut distances, mut indices) = (vec![f64::INFINITY; places.len()], vec![0; places.len()]);
        (
            distances.par_chunks_mut(CHUNK),
            indices.par_chunks_mut(CHUNK),
            places.par_chunks(CHUNK),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (distances, indices, places))| {
                for (at, &place) in places.iter().enumerate() {
                    let guess = guesses.map(|guesses| guesses[chunk * CHUNK + at] as usize);
                    let start = guess.map_or((f64::INFINITY, None), |index| {
                        (squared_distance(self.points[index], place), Some(index))
                    });
                    if let (squared, Some(index)) = self.tree.nearer(place, start)
                        && squared.is_finite()
                    {
                        (distances[at], indices[at]) = (squared.sqrt(), index as u32);
                    }
                }
            });
        Ok((distances, indices))
    }
}
