//! Draws text on images, with letters of 3 by 5 points, for episode indices and column names.

/// Width and height of a letter in points.
const SIZE: (usize, usize) = (3, 5);

/// The rows of a letter from top to bottom. Bit 2 of a row is the left point, bit 0 the right point.
fn glyph(letter: char) -> [u8; 5] {
    match letter.to_ascii_lowercase() {
        '0' => [7, 5, 5, 5, 7],
        '1' => [2, 6, 2, 2, 7],
        '2' => [7, 1, 7, 4, 7],
        '3' => [7, 1, 3, 1, 7],
        '4' => [5, 5, 7, 1, 1],
        '5' => [7, 4, 7, 1, 7],
        '6' => [7, 4, 7, 5, 7],
        '7' => [7, 1, 2, 2, 2],
        '8' => [7, 5, 7, 5, 7],
        '9' => [7, 5, 7, 1, 7],
        'a' => [2, 5, 7, 5, 5],
        'b' => [6, 5, 6, 5, 6],
        'c' => [3, 4, 4, 4, 3],
        'd' => [6, 5, 5, 5, 6],
        'e' => [7, 4, 6, 4, 7],
        'f' => [7, 4, 6, 4, 4],
        'g' => [3, 4, 5, 5, 3],
        'h' => [5, 5, 7, 5, 5],
        'i' => [7, 2, 2, 2, 7],
        'j' => [1, 1, 1, 5, 2],
        'k' => [5, 5, 6, 5, 5],
        'l' => [4, 4, 4, 4, 7],
        'm' => [5, 7, 7, 5, 5],
        'n' => [6, 5, 5, 5, 5],
        'o' => [2, 5, 5, 5, 2],
        'p' => [6, 5, 6, 4, 4],
        'q' => [2, 5, 5, 2, 1],
        'r' => [6, 5, 6, 5, 5],
        's' => [3, 4, 2, 1, 6],
        't' => [7, 2, 2, 2, 2],
        'u' => [5, 5, 5, 5, 7],
        'v' => [5, 5, 5, 5, 2],
        'w' => [5, 5, 7, 7, 5],
        'x' => [5, 5, 2, 5, 5],
        'y' => [5, 5, 2, 2, 2],
        'z' => [7, 1, 2, 4, 7],
        '.' => [0, 0, 0, 0, 2],
        '_' => [0, 0, 0, 0, 7],
        '-' => [0, 0, 7, 0, 0],
        '/' => [1, 1, 2, 4, 4],
        ' ' => [0; 5],
        _ => [7, 7, 7, 7, 7],
    }
}

/// Height of a line of text in pixels. A point is a square with side `scale`.
pub(super) const fn height(scale: usize) -> usize {
    (SIZE.1 + 2) * scale
}

/// Width of a text in pixels.
pub(super) fn width(text: &str, scale: usize) -> usize {
    (text.chars().count() * (SIZE.0 + 1) + 1) * scale
}

/// Draws white text on an image `[height, image_width, 3]`, with the upper left corner of the text at `(left, top)`.
/// Letters beyond `right` are omitted.
pub(super) fn draw(
    rgb: &mut [u8],
    image_width: usize,
    (left, top): (usize, usize),
    right: usize,
    scale: usize,
    text: &str,
) {
    for (i, letter) in text.chars().enumerate() {
        let (x, y) = (left + (i * (SIZE.0 + 1) + 1) * scale, top + scale);
        if x + SIZE.0 * scale > right.min(image_width) {
            return;
        }
        for (row, bits) in glyph(letter).into_iter().enumerate() {
            for point in (0..SIZE.0).filter(|point| bits >> (SIZE.0 - 1 - point) & 1 == 1) {
                for line in 0..scale {
                    let at = ((y + row * scale + line) * image_width + x + point * scale) * 3;
                    rgb[at..at + scale * 3].fill(255);
                }
            }
        }
    }
}
