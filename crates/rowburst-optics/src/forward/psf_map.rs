//! The frame of a given video as a linear map of the PSF.
//!
//! ```text
//! b[r, x] = Σ_{y',x'} l_k[y', x'] · p[r − sy(y'), x − sx(x')],    l_k = Σ_j w_k[j] v_j
//! ```
//!
//! `l_k` is the light of the instant `k` that reads row `r`. The map takes any `p`, also a negative one. Only field rows
//! with light are computed, so it is fast for sparse videos.

use super::RollingShutter;
use super::geometry::Geometry;
use rayon::prelude::*;
use realfft::{ComplexToReal, RealToComplex};
use rowburst_core::fft::FftNumber;
use rustfft::num_complex::Complex32;
use std::sync::Arc;

/// The map `B` from a PSF `[y, x]`, in row order, to a frame `[y, x]`.
pub struct PsfMap {
    geometry: Geometry,
    /// Rows and columns of the PSF.
    psf: (usize, usize),
    frame_rows: usize,
    instants: Vec<Instant>,
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn ComplexToReal<f32>>,
    length: usize,
}

/// The light of an instant.
struct Instant {
    sensor_rows: Vec<usize>,
    frame_rows: Vec<usize>,
    /// Field rows with light, ascending.
    active: Vec<usize>,
    /// The spectrum along x of each of these rows.
    spectra: Vec<Complex32>,
}

impl PsfMap {
    /// The map of `video` for PSFs of `psf` rows and columns.
    pub fn new(shutter: &RollingShutter, psf: (usize, usize), video: &[f32]) -> Self {
        let geometry = shutter.geometry.clone();
        let length = geometry.fft_columns();
        let (forward, inverse) = f32::real_transforms(length);
        let instants = (0..shutter.sensor_rows_of.len()).into_par_iter().map(|i| {
            let light = shutter.light(video, i);
            let light = light.all(shutter.video.pixels());
            let lines: Vec<&[f32]> = light.chunks_exact(geometry.field_columns).collect();
            let active: Vec<usize> = (0..lines.len())
                .filter(|&y| lines[y].iter().any(|v| *v != 0.0))
                .collect();
            let spectra = active.iter().flat_map(|&y| {
                let mut line = vec![0.0; length];
                line[..lines[y].len()].copy_from_slice(lines[y]);
                spectrum_of(&*forward, &mut line)
            });
            Instant {
                sensor_rows: shutter.sensor_rows_of[i].clone(),
                frame_rows: shutter.frame_rows_of[i].clone(),
                spectra: spectra.collect(),
                active,
            }
        });
        Self {
            instants: instants.collect(),
            frame_rows: shutter.frame_row_count,
            geometry,
            psf,
            forward,
            inverse,
            length,
        }
    }

    /// Number of values of a spectrum.
    fn frequencies(&self) -> usize {
        self.length / 2 + 1
    }

    /// Row of the PSF that takes field row `y` to sensor row `r`.
    fn psf_row(&self, r: usize, y: usize) -> Option<usize> {
        let row = self.geometry.row_displacement(r, y) + (self.psf.0 / 2) as isize;
        usize::try_from(row).ok().filter(|row| *row < self.psf.0)
    }

    /// Pairs of a position in a line of the transform and the PSF's column there.
    fn columns(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let columns = self.geometry.columns as isize;
        let first = 1 - self.geometry.field_columns as isize;
        (first..columns).filter_map(move |shift| {
            let displacement = shift + self.geometry.offset_columns as isize;
            let column = usize::try_from(displacement + (self.psf.1 / 2) as isize).ok()?;
            let position = shift.rem_euclid(self.length as isize) as usize;
            (column < self.psf.1).then_some((position, column))
        })
    }

    /// `B psf`.
    pub fn apply(&self, psf: &[f32]) -> Vec<f32> {
        let frequencies = self.frequencies();
        let columns: Vec<(usize, usize)> = self.columns().collect();
        let spectra: Vec<Complex32> = psf
            .par_chunks_exact(self.psf.1)
            .flat_map_iter(|row| {
                let mut line = vec![0.0; self.length];
                columns
                    .iter()
                    .for_each(|&(position, column)| line[position] = row[column]);
                spectrum_of(&*self.forward, &mut line)
            })
            .collect();
        let lines = self.instants.par_iter().map(|instant| {
            let rows = instant.sensor_rows.iter().map(|&r| {
                let mut sum = vec![Complex32::default(); frequencies];
                for (light, &y) in instant
                    .spectra
                    .chunks_exact(frequencies)
                    .zip(&instant.active)
                {
                    if let Some(row) = self.psf_row(r, y) {
                        let kernel = &spectra[row * frequencies..(row + 1) * frequencies];
                        let products = light.iter().zip(kernel);
                        sum.iter_mut()
                            .zip(products)
                            .for_each(|(s, (l, k))| *s += l * k);
                    }
                }
                self.line_of(sum)
            });
            rows.collect::<Vec<_>>()
        });
        let lines: Vec<Vec<Vec<f32>>> = lines.collect();
        let columns = self.geometry.columns;
        let mut frame = vec![0.0; self.frame_rows * columns];
        for (instant, lines) in self.instants.iter().zip(lines) {
            for (&row, line) in instant.frame_rows.iter().zip(lines) {
                frame[row * columns..(row + 1) * columns].copy_from_slice(&line[..columns]);
            }
        }
        frame
    }

    /// `Bᵀ frame`.
    pub fn adjoint(&self, frame: &[f32]) -> Vec<f32> {
        let (frequencies, columns) = (self.frequencies(), self.geometry.columns);
        let spectra: Vec<Complex32> = frame
            .par_chunks_exact(columns)
            .flat_map_iter(|row| {
                let mut line = vec![0.0; self.length];
                line[..columns].copy_from_slice(row);
                spectrum_of(&*self.forward, &mut line)
            })
            .collect();
        let positions: Vec<(usize, usize)> = self.columns().collect();
        (0..self.psf.0)
            .into_par_iter()
            .flat_map_iter(|row| {
                let mut sum = vec![Complex32::default(); frequencies];
                for instant in &self.instants {
                    for (&r, &frame_row) in instant.sensor_rows.iter().zip(&instant.frame_rows) {
                        // The field row that the PSF's row takes to the sensor row.
                        let y = self.geometry.row_displacement(r, 0) + (self.psf.0 / 2) as isize
                            - row as isize;
                        let Some(at) = usize::try_from(y)
                            .ok()
                            .and_then(|y| instant.active.binary_search(&y).ok())
                        else {
                            continue;
                        };
                        let light = &instant.spectra[at * frequencies..(at + 1) * frequencies];
                        let values =
                            &spectra[frame_row * frequencies..(frame_row + 1) * frequencies];
                        let products = light.iter().zip(values);
                        sum.iter_mut()
                            .zip(products)
                            .for_each(|(s, (l, b))| *s += l.conj() * b);
                    }
                }
                let line = self.line_of(sum);
                let mut values = vec![0.0; self.psf.1];
                positions
                    .iter()
                    .for_each(|&(position, column)| values[column] = line[position]);
                values
            })
            .collect()
    }

    /// The line with `spectrum`.
    fn line_of(&self, mut spectrum: Vec<Complex32>) -> Vec<f32> {
        // The transform refuses a constant part that is not real.
        spectrum[0].im = 0.0;
        if self.length.is_multiple_of(2) {
            spectrum[self.length / 2].im = 0.0;
        }
        let mut line = vec![0.0; self.length];
        self.inverse
            .process(&mut spectrum, &mut line)
            .expect("lengths match");
        line.iter_mut().for_each(|v| *v /= self.length as f32);
        line
    }
}

fn spectrum_of(forward: &dyn RealToComplex<f32>, line: &mut [f32]) -> Vec<Complex32> {
    let mut spectrum = forward.make_output_vec();
    forward.process(line, &mut spectrum).expect("lengths match");
    spectrum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::{Camera, Image, Psf, Sensor, Shutter};
    use rowburst_core::linop::LinearOperator;
    use rowburst_core::vecmath::dot;

    fn values(count: usize, factor: usize) -> Vec<f32> {
        (0..count)
            .map(|i| ((i * factor + i * i) % 23) as f32 / 23.0)
            .collect()
    }

    /// It gives the frame of the operator, and its adjoint is exact, for fields larger than the sensor, long exposures,
    /// and PSFs smaller and larger than both.
    #[test]
    fn is_the_operator_as_a_map_of_the_psf() {
        for (exposure, field, psf) in [
            (1.0, None, (23, 39)),
            (2.5, Some((16, 27)), (7, 9)),
            (1.0, Some((14, 20)), (40, 64)),
        ] {
            let camera = Camera::new(CameraParams {
                rows: 12,
                columns: 20,
                shutter: Shutter::DualInsideOut,
                row_time_us: 10.0,
                exposure_us: 10.0 * exposure,
                bins_per_row: 1,
                field,
                sensor: Sensor::default(),
            })
            .unwrap();
            let image = Image::new(psf.0, psf.1, values(psf.0 * psf.1, 7)).unwrap();
            let shutter = RollingShutter::new(&camera, Psf::new(image).unwrap());
            let mut video = values(shutter.domain_len(), 5);
            // Some rows are dark.
            video
                .iter_mut()
                .enumerate()
                .filter(|(i, _)| i / 60 % 3 == 0)
                .for_each(|(_, v)| *v = 0.0);
            let map = PsfMap::new(&shutter, psf, &video);
            let known = shutter.layers[0].psf.image().data();
            let mut expected = vec![0.0; shutter.range_len()];
            shutter.apply(&video, &mut expected);
            let found = map.apply(known);
            let largest = expected.iter().copied().fold(0.0, f32::max);
            for (found, expected) in found.iter().zip(&expected) {
                assert!(
                    (found - expected).abs() < 1e-5 * largest,
                    "{found} {expected}"
                );
            }
            let frame: Vec<f32> = values(found.len(), 3).iter().map(|v| v - 0.5).collect();
            let signed: Vec<f32> = values(known.len(), 11).iter().map(|v| v - 0.5).collect();
            let (left, right) = (
                dot(&map.apply(&signed), &frame),
                dot(&signed, &map.adjoint(&frame)),
            );
            assert!(
                (left - right).abs() < 1e-4 * left.abs().max(1.0),
                "{left} {right}"
            );
        }
    }
}
