//! Faults that a disk shows on no demand.
