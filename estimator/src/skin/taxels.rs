//! The file of a skin's taxels: where each one is and which way it faces.
//!
//! One row per taxel, in the order of their numbers (twelve per triangle, triangle after triangle),
//! of six numbers: position \[m\] and outward normal in the axes of a link's frame, from its
//! origin. Numbers are separated by spaces or commas. A normal of zeros: there is no taxel of that
//! number. Lines that begin with `#` are comments. If there is a line `[calibration]`, the rows
//! begin after it: that is the form of iCub's own files (`positions/*.txt` of skinGui in
//! icub-main). Otherwise one line of column names may come first.

use proprio_dynamics::spatial::Vec3;
use std::path::Path;

/// One taxel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Taxel {
    /// Its position \[m\].
    pub position: Vec3,
    /// Its outward normal, a unit vector.
    pub normal: Vec3,
}

/// The taxels of a file, by number; none where there is no taxel.
#[derive(Debug, Clone, PartialEq)]
pub struct TaxelMap(pub Vec<Option<Taxel>>);

impl TaxelMap {
    /// Reads a file.
    ///
    /// # Errors
    /// A text that states file, line, what is wrong and what is allowed.
    pub fn load(file: &Path) -> Result<Self, String> {
        let at = |problem: String| format!("{}: {problem}", file.display());
        let text = std::fs::read_to_string(file).map_err(|e| at(format!("cannot be read: {e}")))?;
        Self::parse(&text).map_err(at)
    }

    /// Reads the text of a file.
    ///
    /// # Errors
    /// As [`TaxelMap::load`], without the file.
    pub fn parse(text: &str) -> Result<Self, String> {
        let marked = text.lines().position(|line| line.trim() == "[calibration]");
        let mut taxels = Vec::new();
        let mut may_be_header = marked.is_none();
        for (number, line) in (1..)
            .zip(text.lines())
            .skip(marked.map_or(0, |line| line + 1))
        {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let fields = line.split(|c: char| c == ',' || c.is_whitespace());
            let numbers: Vec<Option<f64>> = (fields.filter(|field| !field.is_empty()))
                .map(|field| field.parse().ok().filter(|x: &f64| x.is_finite()))
                .collect();
            if std::mem::take(&mut may_be_header) && numbers.iter().all(Option::is_none) {
                continue;
            }
            let &[Some(x), Some(y), Some(z), Some(nx), Some(ny), Some(nz), ..] = &numbers[..]
            else {
                return Err(format!(
                    "line {number} is {line:?}: six numbers are needed, the position [m] and the \
                     normal of a taxel"
                ));
            };
            let normal = Vec3::new(nx, ny, nz);
            taxels.push(normal.try_normalize(1e-6).map(|normal| Taxel {
                position: Vec3::new(x, y, z),
                normal,
            }));
        }
        match taxels.iter().flatten().next() {
            None => Err("it has no taxel: rows of position [m] and normal are needed".into()),
            Some(_) => Ok(Self(taxels)),
        }
    }

    /// The typical distance of neighbours: the median distance from a taxel to the nearest one that
    /// is elsewhere \[m\]; none if all are in one place. (Files may have one place for several
    /// taxels of a triangle.)
    #[must_use]
    pub fn pitch(&self) -> Option<f64> {
        let taxels: Vec<&Taxel> = self.0.iter().flatten().collect();
        let nearest = |own: &Taxel| {
            let distances = taxels
                .iter()
                .map(|other| (other.position - own.position).norm());
            distances.filter(|d| *d > 1e-6).min_by(f64::total_cmp)
        };
        let mut distances: Vec<f64> = taxels.iter().filter_map(|own| nearest(own)).collect();
        distances.sort_unstable_by(f64::total_cmp);
        distances.get(distances.len() / 2).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A made-up file in the form of iCub's.
    const ICUB: &str = "name    l_forearm\nspatial_sampling  taxel\ntaxel2Repr ( 1 1 -1 )\n\
                        [calibration]\n-0.031\t-0.075\t 0.008\t-0.8 0.0 0.6\n\
                        \n 0.029 -0.076 0.017  0 2 0\n0.0 0.0 0.0 -0.0 0.0 0.0\n";

    #[test]
    fn a_file_of_icub_is_read_as_it_is() {
        let TaxelMap(taxels) = TaxelMap::parse(ICUB).unwrap();
        let [Some(first), Some(second), None] = taxels[..] else {
            panic!("{taxels:?}")
        };
        assert_eq!(first.position, Vec3::new(-0.031, -0.075, 0.008));
        assert!((first.normal - Vec3::new(-0.8, 0.0, 0.6)).norm() < 1e-12);
        assert_eq!(second.normal, Vec3::y());
    }

    #[test]
    fn a_table_with_commas_is_the_same() {
        let table = "x,y,z,nx,ny,nz\n# the inner side\n-0.031, -0.075, 0.008, -0.8, 0, 0.6\n\
                     0.029,-0.076,0.017,0,1,0\n0,0,0,0,0,0\n";
        assert_eq!(TaxelMap::parse(table), TaxelMap::parse(ICUB));
    }

    #[test]
    fn the_pitch_is_that_of_places() {
        let row = |x: f64| format!("{x} 0 0 0 0 1\n");
        let text: String = [0.0, 0.006, 0.006, 0.012, 0.019].map(row).concat();
        let pitch = TaxelMap::parse(&text).unwrap().pitch().unwrap();
        assert!((pitch - 0.006).abs() < 1e-12, "{pitch}");
        assert_eq!(TaxelMap::parse(&row(1.0)).unwrap().pitch(), None);
    }

    #[test]
    fn mistakes_are_told_with_their_line() {
        for (text, told) in [
            ("", "it has no taxel"),
            ("x y z nx ny nz\n", "it has no taxel"),
            ("0 0 0 0 0 0\n", "it has no taxel"),
            (
                "1 2 3 0 0 1\n1 2 3\n",
                "line 2 is \"1 2 3\": six numbers are needed",
            ),
            ("a b\nc d\n", "line 2 is \"c d\""),
            ("1 2 nan 0 0 1\n", "line 1"),
            ("[calibration]\nx y z\n", "line 2"),
        ] {
            let problem = TaxelMap::parse(text).unwrap_err();
            assert!(problem.contains(told), "{text:?}: {problem}");
        }
        let missing = TaxelMap::load(Path::new("no_such_file.txt")).unwrap_err();
        assert!(
            missing.contains("no_such_file.txt: cannot be read"),
            "{missing}"
        );
    }
}
