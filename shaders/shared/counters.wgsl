// Counters of a submission, which the host reads back. Cleared before the first stage of the submission.
struct Counters {
    // Number of entries of the candidate lists, including those beyond the capacity.
    list_end: atomic<u32>,
    vertices: atomic<u32>,
    triangles: atomic<u32>,
    // Number of vertices without a gradient.
    flat: atomic<u32>,
    // Sum of the shares of all directed edges, lower half first.
    checksum: array<atomic<u32>, 2>,
    // Number of triangles with a corner twice.
    degenerate: atomic<u32>,
    // Number of words of the blocks of sheets without the table of offsets, including those beyond the capacity.
    sheet_words: atomic<u32>,
    // Keys of the highest position per axis, and of the highest negative position.
    bounds: array<atomic<u32>, 6>,
}
