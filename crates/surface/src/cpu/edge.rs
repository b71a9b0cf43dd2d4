//! Grid edges of a brick, on which its vertices lie.

/// Grid points along a brick's side with the neighbours' first layer.
const N: u16 = 9;
const SIDE: usize = N as usize;
/// Number of grid edges of a brick with those layers, three per grid point, `3·((z·9 + y)·9 + x) + axis`, rounded up to
/// a power of two so that a mask bounds an index.
pub(super) const EDGES: usize = (3 * SIDE * SIDE * SIDE).next_power_of_two();

/// Edge of a brick: `z << 8 | (8·y + x) << 2 | axis` of its first grid point, and bit 11 if that point is inside.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Edge(u16);

const STARTS_INSIDE: u16 = 1 << 11;

impl Edge {
    /// The edge along `axis` from the grid point at `bit` of layer z.
    #[inline(always)]
    pub(super) fn new(z: usize, bit: usize, axis: usize) -> Self {
        // Eleven bits.
        Self(u16::try_from((z & 7) << 8 | (bit & 63) << 2 | axis & 3).unwrap_or_default())
    }

    /// The same edge, with the side of its first grid point.
    #[inline(always)]
    pub(super) fn starting_inside(self, inside: bool) -> Self {
        Self(self.0 & !STARTS_INSIDE | if inside { STARTS_INSIDE } else { 0 })
    }

    /// Returns true if the first grid point is inside.
    #[inline(always)]
    pub(super) fn starts_inside(self) -> bool {
        self.0 & STARTS_INSIDE != 0
    }

    /// 0 x, 1 y, 2 z.
    #[inline(always)]
    pub(super) fn axis(self) -> u16 {
        self.0 & 3
    }

    /// X coordinate of its grid point.
    #[inline(always)]
    pub(super) fn x(self) -> u16 {
        self.0 >> 2 & 7
    }

    /// Y coordinate of its grid point.
    #[inline(always)]
    pub(super) fn y(self) -> u16 {
        self.0 >> 5 & 7
    }

    /// Z coordinate of its grid point.
    #[inline(always)]
    pub(super) fn z(self) -> u16 {
        self.0 >> 8 & 7
    }

    /// Returns the axes (bits: 0 x, 1 y, 2 z) along which both its ends lie in the brick's first layer.
    #[inline(always)]
    pub(super) fn first_layers(self) -> usize {
        let first = [self.x(), self.y(), self.z()].map(|c| usize::from(c == 0));
        (first[0] | first[1] << 1 | first[2] << 2) & !(1 << self.axis())
    }

    /// Returns a key in the order of the brick's vertices: layer (3 bits), axis (2 bits) and bit (6 bits).
    #[inline(always)]
    pub(super) fn key(self) -> u16 {
        self.0 & 7 << 8 | self.axis() << 6 | self.0 >> 2 & 63
    }

    /// Index among the brick's grid points and cells: `(z·8 + y)·8 + x`.
    #[inline(always)]
    pub(super) fn grid_point(self) -> usize {
        usize::from(self.0 >> 2 & 511)
    }

    /// Index among the grid edges of the brick and its neighbours' first layers.
    #[inline(always)]
    pub(super) fn index(self) -> usize {
        self.index_from([0; 3])
    }

    /// Index among the grid edges of a brick from which this brick is `far` (0 or 8 per axis) away.
    #[inline(always)]
    pub(super) fn index_from(self, far: [usize; 3]) -> usize {
        let [x, y, z] = [self.x(), self.y(), self.z()].map(usize::from);
        let point = ((z + far[2]) * SIDE + y + far[1]) * SIDE + x + far[0];
        (3 * point + usize::from(self.axis())) % EDGES
    }
}

/// Cell of each grid edge's first grid point; an edge beyond the brick belongs to the brick's last cell before it.
pub(super) static CELL_OF: [u16; EDGES] = {
    let mut cells = [0; EDGES];
    let mut point = 0;
    while point < N * N * N {
        let at = [point % N, point / N % N, point / (N * N)];
        let (mut cell, mut k) = (0, 3);
        while k > 0 {
            k -= 1;
            cell = 8 * cell + if at[k] < 8 { at[k] } else { 7 };
        }
        let edge = 3 * point as usize;
        (cells[edge], cells[edge + 1], cells[edge + 2]) = (cell, cell, cell);
        point += 1;
    }
    cells
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_return_their_coordinates() {
        for (z, y, x, axis) in (0..8 * 8 * 8 * 3).map(|i| (i / 192, i / 24 % 8, i / 3 % 8, i % 3)) {
            let plain = Edge::new(z, 8 * y + x, axis);
            for (edge, inside) in [(plain, false), (plain.starting_inside(true), true)] {
                assert_eq!([edge.x(), edge.y(), edge.z(), edge.axis()].map(usize::from), [x, y, z, axis]);
                assert_eq!((edge.grid_point(), edge.index()), ((z * 8 + y) * 8 + x, 3 * ((z * 9 + y) * 9 + x) + axis));
                assert_eq!((edge.key(), edge.first_layers()), (plain.key(), plain.first_layers()));
                assert_eq!(usize::from(CELL_OF[edge.index()]), edge.grid_point());
                assert_eq!((edge.starts_inside(), edge.starting_inside(false)), (inside, plain));
            }
        }
        assert_eq!(CELL_OF[Edge::new(1, 8 * 3, 1).index_from([8, 0, 0])], (8 + 3) * 8 + 7, "beyond x");
        assert_eq!(CELL_OF[Edge::new(0, 0, 2).index_from([0, 8, 8])], (7 * 8 + 7) * 8, "beyond y and z");
    }
}
