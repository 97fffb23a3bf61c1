//! The PLY file of 3D Gaussian splatting: one vertex per Gaussian with logarithmic scales, opacity before the
//! sigmoid, quaternion w first, and colour as spherical harmonics.

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::Path;

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    Addable, ElementDef, Encoding, Ply, Property, PropertyAccess, PropertyAccessResult, PropertyDef,
    PropertyType, ScalarType,
};
use ply_rs_bw::writer::Writer;

use super::splats::Splats;

/// What every such file has, in the order of [`Vertex`]; `f_rest_*` follow.
const REQUIRED: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];
/// Harmonics above the constant one at degree 3, times three channels.
const MOST_REST: usize = 45;
const SLOTS: usize = REQUIRED.len() + MOST_REST;

/// The numbers of one Gaussian as the file has them.
struct Vertex([f32; SLOTS]);

/// Where in a [`Vertex`] a property goes.
fn slot(name: &str) -> Option<usize> {
    match name.strip_prefix("f_rest_") {
        Some(number) => {
            let index: usize = number.parse().ok()?;
            (index < MOST_REST).then_some(REQUIRED.len() + index)
        }
        None => REQUIRED.iter().position(|&required| required == name),
    }
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self([0.0; SLOTS])
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let Some(slot) = slot(name) else {
            return PropertyAccessResult::Ignored;
        };
        match property.to_f32_lossy() {
            Some(value) => {
                self.0[slot] = value;
                PropertyAccessResult::Set
            }
            None => PropertyAccessResult::UnsupportedType,
        }
    }

    fn get_float(&self, name: &str) -> Option<f32> {
        // Viewers expect the unused normal to be there.
        slot(name).map_or(Some(0.0), |slot| Some(self.0[slot]))
    }
}

/// Reads a scene, binary or text. Properties beyond the usual ones are ignored.
///
/// # Errors
/// A sentence that names what the file lacks, has too much of, or where it holds NaN or an infinity.
pub(crate) fn read(path: &Path) -> Result<Splats, String> {
    let name = path.display();
    let file = File::open(path).map_err(|e| format!("{name}: {e}"))?;
    let mut reader = Reader::new(BufReader::with_capacity(1 << 20, file));
    let parser = Parser::<Vertex>::new();
    let header = parser
        .read_header(&mut reader)
        .map_err(|e| format!("{name}: expected a PLY file: {e}"))?;
    let element = header
        .elements
        .get("vertex")
        .ok_or_else(|| format!("{name}: expected an element `vertex`"))?;
    let degree = check_properties(element).map_err(|e| format!("{name}: {e}"))?;
    for element in header.elements.values() {
        let vertices = parser
            .read_payload_for_element(&mut reader, element, &header)
            .map_err(|e| format!("{name}: {e}"))?;
        if element.name == "vertex" {
            return splats(&vertices, degree).map_err(|e| format!("{name}: {e}"));
        }
    }
    Err(format!("{name}: expected an element `vertex`"))
}

/// The degree of the harmonics, if everything that is needed is there.
fn check_properties(element: &ElementDef) -> Result<usize, String> {
    let missing: Vec<&str> = REQUIRED
        .into_iter()
        .filter(|&name| !element.properties.contains_key(name))
        .collect();
    if !missing.is_empty() {
        return Err(format!(
            "expected the vertex properties of a splat file, missing {}",
            missing.join(", ")
        ));
    }
    let rest = element
        .properties
        .keys()
        .filter(|name| name.starts_with("f_rest_"))
        .count();
    let degree = (0..=3)
        .find(|degree: &usize| rest == 3 * ((degree + 1).pow(2) - 1))
        .ok_or_else(|| format!("expected 0, 9, 24 or 45 properties f_rest_*, found {rest}"))?;
    match (0..rest).find(|i| !element.properties.contains_key(&format!("f_rest_{i}"))) {
        Some(i) => Err(format!(
            "expected f_rest_0 to f_rest_{}, missing f_rest_{i}",
            rest - 1
        )),
        None => Ok(degree),
    }
}

fn splats(vertices: &[Vertex], degree: usize) -> Result<Splats, String> {
    let rest = (degree + 1).pow(2) - 1;
    let used = REQUIRED.len() + 3 * rest;
    let mut splats = Splats {
        degree,
        ..Splats::default()
    };
    for (index, Vertex(v)) in vertices.iter().enumerate() {
        if let Some(slot) = v[..used].iter().position(|value| !value.is_finite()) {
            let property = REQUIRED.get(slot).map_or_else(
                || format!("f_rest_{}", slot - REQUIRED.len()),
                ToString::to_string,
            );
            return Err(format!(
                "expected finite numbers, vertex {index} has {property} = {}",
                v[slot]
            ));
        }
        splats.means.push([v[0], v[1], v[2]]);
        splats.harmonics.push([v[3], v[4], v[5]]);
        // The file has all of red, then all of green, then all of blue.
        let higher = &v[REQUIRED.len()..used];
        splats
            .harmonics
            .extend((0..rest).map(|k| [higher[k], higher[rest + k], higher[2 * rest + k]]));
        splats.opacities.push(1.0 / (1.0 + (-v[6]).exp()));
        splats.scales.push([v[7].exp(), v[8].exp(), v[9].exp()]);
        splats.quats.push([v[10], v[11], v[12], v[13]]);
    }
    Ok(splats)
}

/// Writes a scene as binary, in the order of properties that viewers are used to.
pub(crate) fn write(path: &Path, splats: &Splats) -> Result<(), String> {
    let rest = (splats.degree + 1).pow(2) - 1;
    let mut element = ElementDef::new("vertex".into());
    let (head, tail) = REQUIRED.split_at(6);
    let names = head[..3]
        .iter()
        .chain(&["nx", "ny", "nz"])
        .chain(&head[3..])
        .map(ToString::to_string)
        .chain((0..3 * rest).map(|i| format!("f_rest_{i}")))
        .chain(tail.iter().map(ToString::to_string));
    for name in names {
        element
            .properties
            .add(PropertyDef::new(name, PropertyType::Scalar(ScalarType::Float)));
    }
    let vertices = (0..splats.len()).map(|i| {
        let mut vertex = Vertex::new();
        let harmonics = &splats.harmonics[i * (rest + 1)..][..rest + 1];
        // An opacity of 1 has no finite logit, a scale of 0 no finite logarithm.
        let opacity = splats.opacities[i].clamp(1e-6, 1.0 - 1e-6);
        let head = splats.means[i]
            .into_iter()
            .chain(harmonics[0])
            .chain([(opacity / (1.0 - opacity)).ln()])
            .chain(splats.scales[i].map(|s| s.max(1e-12).ln()))
            .chain(splats.quats[i]);
        let higher = (0..3).flat_map(|channel| harmonics[1..].iter().map(move |rgb| rgb[channel]));
        for (slot, value) in vertex.0.iter_mut().zip(head.chain(higher)) {
            *slot = value;
        }
        vertex
    });
    let mut ply = Ply::<Vertex>::new();
    ply.header.encoding = Encoding::BinaryLittleEndian;
    ply.header.elements.add(element);
    ply.payload.insert("vertex".into(), vertices.collect());
    let file = File::create(path).map_err(|e| format!("{}: {e}", path.display()))?;
    Writer::new()
        .write_ply(&mut BufWriter::new(file), &mut ply)
        .map(|_| ())
        .map_err(|e| format!("{}: {e}", path.display()))
}
