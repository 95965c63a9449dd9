//! Between which ends values lie.

/// The lowest and the highest of the values that are there: those that are finite. `None` if none is.
pub fn range(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    let known = values.filter(|value| value.is_finite());
    known.fold(None, |ends: Option<[f64; 2]>, value| {
        let [low, high] = ends.unwrap_or([value; 2]);
        Some([low.min(value), high.max(value)])
    })
}
