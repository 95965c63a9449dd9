//! A table of open-circuit voltages, and what it does not tell between its points.

/// Straight lines between the points of the table and beyond its ends.
pub fn open_circuit_v(table: &[(f64, f64)], soc: &[f64]) -> Vec<f64> {
    match table {
        [] => vec![0.0; soc.len()],
        [only] => vec![only.1; soc.len()],
        _ => {
            let last = table.len() - 2;
            // The line in use, and where it ends.
            let (mut at, mut low, mut high) = (0, f64::INFINITY, f64::NEG_INFINITY);
            let (mut from, mut slope) = (table[0], 0.0);
            soc.iter()
                .map(|&soc| {
                    if !(low <= soc && soc < high) {
                        while at > 0 && table[at].0 > soc {
                            at -= 1;
                        }
                        while at < last && table[at + 1].0 <= soc {
                            at += 1;
                        }
                        let to = table[at + 1];
                        from = table[at];
                        slope = (to.1 - from.1) / (to.0 - from.0);
                        low = if at == 0 { f64::NEG_INFINITY } else { from.0 };
                        high = if at == last { f64::INFINITY } else { to.0 };
                    }
                    from.1 + slope * (soc - from.0)
                })
                .collect()
        }
    }
}

/// What the curve may be off the line between two points of its table half-way between them, in V: by the bends of the table at both
/// points, the larger one. The error of linear interpolation is f″·h²/8 (Burden & Faires, *Numerical Analysis*, theorem 3.3).
pub fn bend_v(table: &[(f64, f64)], line: usize) -> f64 {
    let width = |line: usize| table[line + 1].0 - table[line].0;
    let slope_v = |line: usize| (table[line + 1].1 - table[line].1) / width(line);
    let curvature_v = |line: usize| {
        let apart = 0.5 * (width(line) + width(line + 1));
        ((slope_v(line + 1) - slope_v(line)) / apart).abs()
    };
    let bends = line.saturating_sub(1)..(line + 1).min(table.len().saturating_sub(2));
    bends.map(curvature_v).fold(0.0, f64::max) * width(line).powi(2) / 8.0
}

/// Adds parabolas of these heights, in V, over the lines of a table to voltages that were looked up at states of charge.
pub fn bend(table: &[(f64, f64)], heights_v: &[f64], soc: &[f64], volts: &mut [f64]) {
    let mut line = 0;
    for (soc, volts) in soc.iter().zip(volts) {
        while line > 0 && table[line].0 > *soc {
            line -= 1;
        }
        while line + 2 < table.len() && table[line + 1].0 <= *soc {
            line += 1;
        }
        if let (Some(height_v), [from, to, ..]) = (heights_v.get(line), &table[line..]) {
            // Beyond the table the parabola of its last line goes on.
            *volts += height_v * parabola((soc - from.0) / (to.0 - from.0));
        }
    }
}

/// 1 half-way, 0 at the ends.
fn parabola(way: f64) -> f64 {
    4.0 * way * (1.0 - way)
}

/// The table with points between those of the lines that bend, so that straight lines follow the parabolas to a thirtieth.
pub fn bent(table: &[(f64, f64)], heights_v: &[f64]) -> Vec<(f64, f64)> {
    const PARTS: usize = 6;
    let mut all = Vec::new();
    for (line, pair) in table.windows(2).enumerate() {
        let (from, to) = (pair[0], pair[1]);
        all.push(from);
        let height_v = heights_v.get(line).copied().unwrap_or_default();
        let between = (1..PARTS).filter(|_| height_v != 0.0);
        all.extend(between.map(|part| {
            let way = part as f64 / PARTS as f64;
            let volts = from.1 + way * (to.1 - from.1) + height_v * parabola(way);
            (from.0 + way * (to.0 - from.0), volts)
        }));
    }
    all.extend(table.last());
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A curve of constant curvature, in V, read off at three points a fifth apart.
    fn curve(soc: f64) -> f64 {
        3.0 + soc - soc * soc
    }

    fn table() -> Vec<(f64, f64)> {
        [0.1, 0.3, 0.5].map(|soc| (soc, curve(soc))).to_vec()
    }

    #[test]
    fn the_bends_of_a_table_are_those_of_a_parabola_through_it() {
        let table = table();
        let heights_v: Vec<f64> = (0..2).map(|line| bend_v(&table, line)).collect();
        let soc: Vec<f64> = (10..=50)
            .map(|percent| f64::from(percent) / 100.0)
            .collect();
        let mut volts = open_circuit_v(&table, &soc);
        bend(&table, &heights_v, &soc, &mut volts);
        for (soc, volts) in soc.iter().zip(volts) {
            assert!((volts - curve(*soc)).abs() < 1e-12, "{soc}: {volts}");
        }
        // A straight line does not bend, and two points have no bend to be told by.
        assert!(bend_v(&[(0.0, 3.0), (0.5, 3.5), (1.0, 4.0)], 0) < 1e-12);
        assert_eq!(bend_v(&[(0.0, 3.0), (1.0, 4.0)], 0), 0.0);
    }

    #[test]
    fn a_table_with_its_bends_written_in_says_the_same() {
        let (table, heights_v) = (table(), [0.01, -0.02]);
        let soc: Vec<f64> = (0..=60).map(|percent| f64::from(percent) / 100.0).collect();
        let mut volts = open_circuit_v(&table, &soc);
        bend(&table, &heights_v, &soc, &mut volts);
        let written = open_circuit_v(&bent(&table, &heights_v), &soc);
        for ((soc, volts), written) in soc.iter().zip(volts).zip(written) {
            let inside = (0.1..=0.5).contains(soc);
            assert!(!inside || (volts - written).abs() < 0.02 / 30.0, "{soc}");
        }
        assert_eq!(bent(&table, &[]), table);
    }
}
