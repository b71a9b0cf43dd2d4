//! What a job will cost, before it is read: a model with one constant per machine, learned from the jobs that have run.

use crate::pipeline::Job;

/// Bytes of text per atom, about: a line of a PDB file has 81, one of an mmCIF file 90 to 110.
const BYTES_PER_ATOM: f64 = 90.0;
/// How much smaller compressed structure files are, about.
const COMPRESSION: f64 = 4.0;
/// How much smaller atoms are in BinaryCIF than in text, about. Compressed it cannot be told without inflating it; the two
/// differ less then.
const BINARY: f64 = 5.0;
/// Bytes of an archive's BinaryCIF that describe the columns of all its categories, about: as many for a small entry as
/// for a large one.
const DESCRIPTION: f64 = 150e3;
/// Work of the smallest job, in atoms.
const LEAST: f64 = 2_000.0;
/// Time of a mesh whose spacing is searched for, in times of the one that is found: a coarse one goes before it, and now and
/// then there is a third.
const TRIES: f64 = 1.5;
/// Work of a picture's pixel, in atoms: 100 ns of one core, on a machine whose atoms take 4 µs of two.
const PIXEL: f64 = 0.0125;
/// Assumed time of a unit of work before any job has run, s: an atom at 0.5 Å on two cores.
const FIRST_GUESS: f64 = 4e-6;
/// Weight of the newest job in the moving averages.
const NEWEST: f64 = 0.2;

/// Units of work that a job is taken for: atoms at 0.5 Å.
pub(super) fn units(input: &[u8], job: &Job) -> f64 {
    let compressed = input.starts_with(&[0x1f, 0x8b]) || input.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]);
    // A MessagePack map, which no text begins with.
    let binary = matches!(input.first(), Some(0x80..=0x8F | 0xDE | 0xDF));
    let len = input.len() as f64;
    let bytes = match (compressed, binary) {
        (true, _) => len * COMPRESSION,
        (false, true) => len.max((len - DESCRIPTION) * BINARY),
        (false, false) => len,
    };
    let atoms = bytes / BYTES_PER_ATOM;
    // Samples go with the inverse cube of the spacing, the surface with its square, reading with neither.
    let fineness = 0.5 / job.spacing.expected(&job.params, atoms);
    let again = if job.spacing.max_triangles().is_some() { TRIES } else { 1.0 };
    let pixels = job.picture.map_or(0.0, |picture| f64::from(picture.width) * f64::from(picture.height));
    (atoms + LEAST) * (0.3 + 0.7 * again * fineness.powf(2.5)) + PIXEL * pixels
}

/// Seconds per unit, and seconds per job, as lately measured.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rate {
    per_unit: f64,
    per_job: Option<f64>,
}

impl Default for Rate {
    fn default() -> Self {
        Self { per_unit: FIRST_GUESS, per_job: None }
    }
}

impl Rate {
    /// Expected seconds of so many units.
    pub(super) fn seconds(&self, units: f64) -> f64 {
        self.per_unit * units
    }

    /// Mean seconds of the jobs of late; `expected` before there were any.
    pub(super) fn mean(&self, expected: f64) -> f64 {
        self.per_job.unwrap_or(expected)
    }

    /// A job of so many units took `seconds`.
    pub(super) fn learn(&mut self, units: f64, seconds: f64) {
        // Against what is expected now, not when the job came: a full queue would correct the same mistake a hundred times.
        // By the logarithm: a job a hundred times as long as expected says no more than one a hundredth as long.
        let miss = (seconds.max(1e-6) / self.seconds(units).max(1e-9)).ln();
        self.per_unit *= (NEWEST * miss.clamp(-4.0, 4.0)).exp();
        self.per_job = Some(self.per_job.map_or(seconds, |mean| mean + NEWEST * (seconds - mean)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::params;

    #[test]
    fn finer_larger_and_compressed_inputs_cost_more() {
        let at = |resolution: &str| params::parse([("resolution", resolution)]).unwrap().job;
        let text = vec![b'A'; 90_000];
        let gzip = [&[0x1f, 0x8b][..], &text].concat();
        let coarse = units(&text, &at("1"));
        assert!(units(&text, &at("0.5")) > 2.0 * coarse);
        assert!(units(&gzip, &at("1")) > 2.0 * coarse);
        let binary = |first: u8| units(&[&[first][..], &vec![0; 450_000]].concat(), &at("1"));
        assert!(binary(0x83) > 2.0 * binary(b'A'));
        assert!((units(&text, &at("0.5")) - 3000.0).abs() < 1.0);
    }

    #[test]
    fn large_pictures_cost_more() {
        let (text, of) =
            (vec![b'A'; 90_000], |side: &str| params::parse([("format", "png"), ("width", side)]).unwrap().job);
        assert!(units(&text, &of("4096")) > 1.2 * units(&text, &of("512")));
    }

    #[test]
    fn a_spacing_that_is_not_given_is_guessed_from_the_bytes() {
        let of = |name: &str, value: &str| params::parse([(name, value)]).unwrap().job;
        let [small, large] = [90_000, 90_000_000].map(|n| vec![b'A'; n]);
        assert!((units(&small, &of("detail", "4")) / units(&small, &of("resolution", "0.5")) - 1.0).abs() < 1e-9);
        // A million atoms at the same level of detail get a coarser grid.
        assert!(units(&large, &of("detail", "4")) < 0.5 * units(&large, &of("resolution", "0.5")));
        let bounded = |most: &str| units(&large, &of("max_triangles", most));
        assert!(bounded("1000000") < bounded("10000000"));
        assert!(bounded("4000000000") > units(&large, &of("resolution", "0.5")));
    }

    #[test]
    fn the_rate_follows_the_machine() {
        let mut rate = Rate::default();
        for _ in 0..50 {
            rate.learn(1e5, 2.0);
        }
        assert!((rate.seconds(1e5) - 2.0).abs() < 0.01, "{rate:?}");
        assert!((rate.mean(0.0) - 2.0).abs() < 1e-9);
        // One stray job does not turn everything over.
        rate.learn(1e5, 2e4);
        assert!(rate.seconds(1e5) < 5.0, "{rate:?}");
        // However many were expected to take something else when they came, it settles.
        for _ in 0..500 {
            rate.learn(1e5, 0.02);
        }
        assert!((rate.seconds(1e5) - 0.02).abs() < 1e-3, "{rate:?}");
    }
}
