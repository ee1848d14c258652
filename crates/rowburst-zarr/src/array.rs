//! Arrays of an archive: Zarr 3, one folder each.

use crate::Scratch;
use crate::store::AtomicStore;
use rowburst::error::{Phrase, With};
use rowburst::{Error, Parameter, Result, phrase};
use rowburst_io::write_error;
use serde_json::{Value, json};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::{Array, ArrayError, ArraySubset};
use zarrs::storage::StorageError;

/// An array of float32 whose missing chunks are NaN.
pub(crate) struct FloatArray {
    path: PathBuf,
    array: Array<AtomicStore>,
    chunks: Vec<u64>,
}

/// What an array looks like.
pub(crate) struct ArrayParams<'a> {
    pub shape: &'a [u64],
    pub chunks: &'a [u64],
    pub names: &'a [&'a str],
    pub attributes: Value,
}

impl FloatArray {
    /// Makes the array `path`, or takes the one that is there with the same shape.
    pub fn create(path: &Path, params: &ArrayParams, scratch: &Arc<Scratch>) -> Result<Self> {
        write_metadata(path, params, ("float32", json!("NaN")), scratch)?;
        let store = AtomicStore::new(path, Arc::clone(scratch));
        let store = Arc::new(store.map_err(|e| storage_fault(path, &e))?);
        let array = Array::open(store, "/");
        Ok(Self {
            path: path.into(),
            array: array.map_err(|e| Error::work(path, e, damaged()))?,
            chunks: params.chunks.to_vec(),
        })
    }

    /// Lengths of a chunk.
    pub fn chunks(&self) -> &[u64] {
        &self.chunks
    }

    /// Writes a whole chunk, all of `chunks` numbers whatever the array's edge.
    pub fn store_chunk(&self, at: &[u64], values: &[f32]) -> Result<()> {
        let stored = self.array.store_chunk(at, values);
        stored.map_err(|e| self.fault(e))
    }

    /// Reads a box.
    pub fn read(&self, ranges: &[Range<u64>]) -> Result<Vec<f32>> {
        let subset = ArraySubset::new_with_ranges(ranges);
        let read = self.array.retrieve_array_subset::<Vec<f32>>(&subset);
        read.map_err(|e| self.fault(e))
    }

    fn fault(&self, error: ArrayError) -> Error {
        match error {
            ArrayError::StorageError(error) => storage_fault(&self.path, &error),
            error => Error::work(&self.path, error, damaged()),
        }
    }
}

/// The remedy for damaged archives.
fn damaged() -> Phrase {
    phrase![
        "The archive is damaged: take another folder",
        With(Parameter::Output),
        "."
    ]
}

/// Writes the coordinates along one axis as an array of float64 in one chunk.
pub(crate) fn write_coordinates(
    path: &Path,
    (name, attributes): (&str, Value),
    values: &[f64],
    scratch: &Arc<Scratch>,
) -> Result<()> {
    let length = [values.len() as u64];
    let params = ArrayParams {
        shape: &length,
        chunks: &length,
        names: &[name],
        attributes,
    };
    let store = AtomicStore::new(path, Arc::clone(scratch));
    let store = Arc::new(store.map_err(|e| storage_fault(path, &e))?);
    write_metadata(path, &params, ("float64", json!("NaN")), scratch)?;
    let fault = |e: ArrayError| match e {
        ArrayError::StorageError(error) => storage_fault(path, &error),
        error => Error::work(path, error, damaged()),
    };
    let array = Array::open(store, "/").map_err(|e| Error::work(path, e, damaged()))?;
    array.store_chunk(&[0], values).map_err(fault)
}

fn write_metadata(
    path: &Path,
    params: &ArrayParams,
    (data_type, fill_value): (&str, Value),
    scratch: &Scratch,
) -> Result<()> {
    let metadata = json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": params.shape,
        "data_type": data_type,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": params.chunks}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill_value,
        "codecs": [
            {"name": "bytes", "configuration": {"endian": "little"}},
            // Most of a video is zeros; zstd alone is smaller than with blosc's shuffle (docs/design/018).
            {"name": "zstd", "configuration": {"level": 3, "checksum": true}},
        ],
        "dimension_names": params.names,
        "attributes": params.attributes,
    });
    let text = serde_json::to_string_pretty(&metadata).expect("plain JSON");
    scratch.put(&path.join("zarr.json"), text.as_bytes())
}

/// The error of a store.
pub(crate) fn storage_fault(path: &Path, error: &StorageError) -> Error {
    match error {
        StorageError::IOError(error) => write_error(error).within(path),
        error => Error::work(path, error, "Check the disk, then try again."),
    }
}
