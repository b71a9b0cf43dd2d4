//! The worker pool. No HTTP type, no wgpu.
