//! Which simple form of what is left is true of an effect that the library lacks.

/// Effects outside the library with the forms that describe them (`form` in report.json); none where nothing simple does. Written down
/// before the campaign was run with forms, `curve` (true of whatever follows the current at once) before it was run with that.
const FORMS: [(&str, &[&str]); 15] = [
    ("quadratic", &["square", "curve"]),
    ("cubic", &["cube", "curve"]),
    ("gain-step", &["slope-step"]),
    ("aux-squared", &["follows-square"]),
    ("eddy-current", &["memory"]),
    ("creep", &["memory"]),
    ("random-walk", &[]),
    ("missing-codes", &[]),
    ("voltage-gain", &["itself"]),
    ("contact-resistance-rise", &["slope-drift"]),
    ("loose-contact", &[]),
    ("ocv-step", &["step-over"]),
    ("charge-resistance", &["direction", "curve"]),
    ("resonance", &["second-order"]),
    ("crossover", &["sign", "curve"]),
];

/// How the form that was told stands to the true one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Told {
    /// It is the true one, or among those that are said not to be told apart.
    Right,
    /// It is another.
    Another,
    /// No form was told.
    None,
}

/// Forms that are true of an effect; `None` if the effect is not on the list.
pub fn of(effect: &str) -> Option<&'static [&'static str]> {
    let found = FORMS.iter().find(|(id, _)| *id == effect);
    found.map(|(_, forms)| *forms)
}

/// Judges the forms that were told of what is left, the first with those that it is not told apart from.
pub fn judged(right: &[&str], told: &[String]) -> Told {
    if told.is_empty() {
        Told::None
    } else if told.iter().any(|form| right.contains(&form.as_str())) {
        Told::Right
    } else {
        Told::Another
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_form_is_right_if_it_is_among_those_that_were_told() {
        let told = |forms: &[&str]| -> Vec<String> { forms.iter().map(|f| (*f).into()).collect() };
        let right = of("quadratic").unwrap_or_default();
        assert_eq!(judged(right, &told(&["square"])), Told::Right);
        assert_eq!(judged(right, &told(&["cube", "square"])), Told::Right);
        assert_eq!(judged(right, &told(&["cube"])), Told::Another);
        assert_eq!(judged(right, &[]), Told::None);
        // Of a random walk any form is wrong.
        assert_eq!(of("random-walk"), Some(&[][..]));
        assert_eq!(judged(&[], &told(&["drift"])), Told::Another);
        assert_eq!(of("gain"), None);
    }
}
