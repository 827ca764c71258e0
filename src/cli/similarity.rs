pub struct Similarity;
impl Similarity {
    pub fn new(_: [usize; 2], _: f64) -> Self {
        Similarity
    }
    pub fn push(&mut self, _: &[f64], _: &[f64]) {}
    pub fn finish(self) -> (f64, u64) {
        (f64::NAN, 0)
    }
}
