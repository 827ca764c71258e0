//! Small pictures: RGB canvas, digits, colour maps, PNG.

use crate::{Error, Result};

/// RGB pixels, row by row from the top.
pub struct Canvas {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<u8>,
}

/// Columns and rows of a character.
pub const GLYPH: [usize; 2] = [5, 7];

impl Canvas {
    /// Of one grey.
    pub fn new(width: usize, height: usize, grey: u8) -> Canvas {
        Canvas { width, height, pixels: vec![grey; width * height * 3] }
    }

    /// Sets a pixel; outside nothing happens.
    pub fn set(&mut self, x: usize, y: usize, rgb: [u8; 3]) {
        if x < self.width && y < self.height {
            let at = (y * self.width + x) * 3;
            self.pixels[at..at + 3].copy_from_slice(&rgb);
        }
    }

    /// Writes a line of text, `scale` pixels a dot; unknown characters are blank. Returns its width.
    pub fn text(&mut self, x: usize, y: usize, text: &str, scale: usize, rgb: [u8; 3]) -> usize {
        let step = (GLYPH[0] + 1) * scale;
        for (i, c) in text.chars().enumerate() {
            for (row, bits) in glyph(c).into_iter().enumerate() {
                for col in (0..GLYPH[0]).filter(|col| bits >> (GLYPH[0] - 1 - col) & 1 == 1) {
                    for d in 0..scale * scale {
                        self.set(x + i * step + col * scale + d % scale, y + row * scale + d / scale, rgb);
                    }
                }
            }
        }
        text.chars().count() * step
    }

    /// As a PNG file.
    pub fn png(&self) -> Result<Vec<u8>> {
        let fail = |e: png::EncodingError| Error::Failed(format!("PNG: {e}"));
        let size = |n: usize| u32::try_from(n).map_err(|_| Error::Failed(format!("PNG: {n} pixels are too many")));
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, size(self.width)?, size(self.height)?);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(fail)?;
        writer.write_image_data(&self.pixels).map_err(fail)?;
        writer.finish().map_err(fail)?;
        Ok(bytes)
    }
}

/// Seven rows of five bits, the leftmost dot highest.
#[rustfmt::skip]
fn glyph(c: char) -> [u8; 7] {
    match c {
        '0' => [0b01110, 0b10001, 0b10011, 0b10101, 0b11001, 0b10001, 0b01110],
        '1' => [0b00100, 0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
        '2' => [0b01110, 0b10001, 0b00001, 0b00110, 0b01000, 0b10000, 0b11111],
        '3' => [0b11110, 0b00001, 0b00001, 0b01110, 0b00001, 0b00001, 0b11110],
        '4' => [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010],
        '5' => [0b11111, 0b10000, 0b11110, 0b00001, 0b00001, 0b10001, 0b01110],
        '6' => [0b00110, 0b01000, 0b10000, 0b11110, 0b10001, 0b10001, 0b01110],
        '7' => [0b11111, 0b00001, 0b00010, 0b00100, 0b01000, 0b01000, 0b01000],
        '8' => [0b01110, 0b10001, 0b10001, 0b01110, 0b10001, 0b10001, 0b01110],
        '9' => [0b01110, 0b10001, 0b10001, 0b01111, 0b00001, 0b00010, 0b01100],
        'A' => [0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001],
        'S' => [0b01111, 0b10000, 0b10000, 0b01110, 0b00001, 0b00001, 0b11110],
        '-' => [0, 0, 0, 0b11111, 0, 0, 0],
        '+' => [0, 0b00100, 0b00100, 0b11111, 0b00100, 0b00100, 0],
        '.' => [0, 0, 0, 0, 0, 0b00110, 0b00110],
        '=' => [0, 0, 0b11111, 0, 0b11111, 0, 0],
        'e' => [0, 0, 0b01110, 0b10001, 0b11111, 0b10000, 0b01110],
        'p' => [0, 0, 0b11110, 0b10001, 0b11110, 0b10000, 0b10000],
        'u' => [0, 0, 0b10001, 0b10001, 0b10001, 0b10011, 0b01101],
        'x' => [0, 0, 0b10001, 0b01010, 0b00100, 0b01010, 0b10001],
        'y' => [0, 0, 0b10001, 0b10001, 0b01111, 0b00001, 0b01110],
        'z' => [0, 0, 0b11111, 0b00010, 0b00100, 0b01000, 0b11111],
        _ => [0; 7],
    }
}

/// A colour map by its knots at equal steps, 8-bit sRGB.
pub struct ColourMap(&'static [[u8; 3]]);

pub const GREY: ColourMap = ColourMap(&[[0, 0, 0], [255, 255, 255]]);
/// Nine samples of matplotlib's viridis (public domain, CC0).
pub const VIRIDIS: ColourMap = ColourMap(&[
    [68, 1, 84],
    [71, 45, 123],
    [59, 82, 139],
    [44, 114, 142],
    [33, 145, 140],
    [40, 174, 128],
    [94, 201, 98],
    [173, 220, 48],
    [253, 231, 37],
]);
/// Nine samples of matplotlib's magma (public domain, CC0).
pub const MAGMA: ColourMap = ColourMap(&[
    [0, 0, 4],
    [28, 16, 68],
    [79, 18, 123],
    [129, 37, 129],
    [181, 54, 122],
    [229, 80, 100],
    [251, 135, 97],
    [254, 194, 135],
    [252, 253, 191],
]);

impl ColourMap {
    /// Colour of `t` in 0..1 (clamped); NaN is blue, which no map has.
    pub fn at(&self, t: f64) -> [u8; 3] {
        if t.is_nan() {
            return [40, 60, 200];
        }
        let last = self.0.len() - 1;
        let t = t.clamp(0.0, 1.0) * last as f64;
        let i = (t as usize).min(last - 1);
        let part = t - i as f64;
        let mix = |c: usize| f64::from(self.0[i][c]) * (1.0 - part) + f64::from(self.0[i + 1][c]) * part;
        std::array::from_fn(|c| mix(c).round() as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_end_where_they_should() {
        assert_eq!(GREY.at(0.5), [128, 128, 128]);
        assert_eq!((VIRIDIS.at(-1.0), VIRIDIS.at(2.0)), ([68, 1, 84], [253, 231, 37]));
        assert_eq!(MAGMA.at(1.0), [252, 253, 191]);
        assert_eq!(GREY.at(f64::NAN), [40, 60, 200]);
    }

    #[test]
    fn text_and_png_hold_what_was_drawn() {
        let mut c = Canvas::new(20, 10, 0);
        assert_eq!(c.text(1, 1, "1z", 1, [255; 3]), 12);
        let lit = c.pixels.chunks(3).filter(|p| p[0] == 255).count();
        let dots = |c| glyph(c).iter().map(|b| b.count_ones() as usize).sum::<usize>();
        assert_eq!(lit, dots('1') + dots('z'));
        c.set(100, 100, [1; 3]);
        let png = c.png().unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(&png)).read_info().unwrap();
        let mut back = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut back).unwrap();
        assert_eq!(back, c.pixels);
    }
}
