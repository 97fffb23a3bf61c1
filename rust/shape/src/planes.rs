use rayon::prelude::*;

use crate::Vec3;

/// Points whose distances to one plane are measured at a time.
const PIECE: usize = 64;

/// The largest signed distance of each point to planes: normal and offset. −∞ without planes.
#[must_use]
pub fn beyond_planes(points: &[Vec3], planes: &[[f64; 4]]) -> Vec<f64> {
    let mut largest = vec![f64::NEG_INFINITY; points.len()];
    (points.par_chunks(PIECE), largest.par_chunks_mut(PIECE))
        .into_par_iter()
        .with_min_len(16)
        .for_each(|(points, largest)| {
            let mut axes = [[0.0; PIECE]; 3];
            for (index, point) in points.iter().enumerate() {
                for i in 0..3 {
                    axes[i][index] = point[i];
                }
            }
            let mut most = [f64::NEG_INFINITY; PIECE];
            for &[a, b, c, offset] in planes {
                for i in 0..PIECE {
                    let distance = axes[0][i] * a + axes[1][i] * b + axes[2][i] * c + offset;
                    // Not `max`, which takes longer for the sake of NaN.
                    most[i] = if distance > most[i] { distance } else { most[i] };
                }
            }
            largest.copy_from_slice(&most[..points.len()]);
        });
    largest
}
