//! Nothing: what this package holds are the property tests in `tests` and the benchmarks in `benches`.
