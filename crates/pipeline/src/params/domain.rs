//! Domains of parameters.

/// Domain of a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Domain {
    /// A number within inclusive bounds, with a unit (may be empty).
    Number {
        /// Lowest value.
        min: f64,
        /// Highest value.
        max: f64,
        /// Unit, such as `Å`.
        unit: &'static str,
    },
    /// An integer within inclusive bounds.
    Integer {
        /// Lowest value.
        min: i64,
        /// Highest value.
        max: i64,
    },
    /// `true` or `false`.
    Flag,
    /// One of these values.
    Choice(&'static [&'static str]),
    /// Free text.
    Text {
        /// Description of valid values.
        expected: &'static str,
    },
}

impl Domain {
    /// Describes the valid values.
    #[must_use]
    pub fn expected(&self) -> String {
        match self {
            Self::Number { min, max, unit: "" } => format!("a number from {min} to {max}"),
            Self::Number { min, max, unit } => format!("a number from {min} to {max} {unit}"),
            Self::Integer { min, max } => format!("a whole number from {min} to {max}"),
            Self::Flag => "true or false".to_owned(),
            Self::Choice(words) => format!("one of {}", words.join(", ")),
            Self::Text { expected } => (*expected).to_owned(),
        }
    }
}
