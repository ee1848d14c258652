//! A folder as a Zarr store whose files are whole or not there.
//!
//! zarrs' own store writes a file in place: a kill in the middle leaves half of it.

use crate::Scratch;
use std::path::Path;
use std::sync::Arc;
use zarrs::filesystem::FilesystemStore;
use zarrs::storage::byte_range::ByteRangeIterator;
use zarrs::storage::{
    Bytes, MaybeBytesIterator, OffsetBytesIterator, ReadableStorageTraits, StorageError, StoreKey,
    StorePrefix, WritableStorageTraits,
};

/// Reads as [`FilesystemStore`], writes through a [`Scratch`] folder.
pub(crate) struct AtomicStore {
    files: FilesystemStore,
    scratch: Arc<Scratch>,
}

impl AtomicStore {
    pub fn new(path: &Path, scratch: Arc<Scratch>) -> Result<Self, StorageError> {
        let files = FilesystemStore::new(path);
        let files = files.map_err(|e| StorageError::Other(e.to_string()))?;
        Ok(Self { files, scratch })
    }
}

impl ReadableStorageTraits for AtomicStore {
    fn get_partial_many<'a>(
        &'a self,
        key: &StoreKey,
        byte_ranges: ByteRangeIterator<'a>,
    ) -> Result<MaybeBytesIterator<'a>, StorageError> {
        self.files.get_partial_many(key, byte_ranges)
    }

    fn size_key(&self, key: &StoreKey) -> Result<Option<u64>, StorageError> {
        self.files.size_key(key)
    }

    fn supports_get_partial(&self) -> bool {
        self.files.supports_get_partial()
    }
}

impl WritableStorageTraits for AtomicStore {
    fn set(&self, key: &StoreKey, value: Bytes) -> Result<(), StorageError> {
        let path = self.files.key_to_fspath(key);
        self.scratch.try_put(&path, &value).map_err(Into::into)
    }

    fn set_partial_many(&self, key: &StoreKey, _: OffsetBytesIterator) -> Result<(), StorageError> {
        let message = format!("{key}: a part of a file cannot be written");
        Err(StorageError::Unsupported(message))
    }

    fn erase(&self, key: &StoreKey) -> Result<(), StorageError> {
        self.files.erase(key)
    }

    fn erase_prefix(&self, prefix: &StorePrefix) -> Result<(), StorageError> {
        self.files.erase_prefix(prefix)
    }

    fn supports_set_partial(&self) -> bool {
        false
    }
}
