//! JPEG: an encoder and a fast decoder for frames of simulations, which have large areas of one colour, and a general
//! decoder for all other JPEG files.

mod annex_k;
mod bit_reader;
mod decode;
#[cfg(test)]
mod decode_tests;
mod encode;
mod forward_dct;
mod general;
mod header;
mod huffman;
mod inverse_dct;
mod planes;
mod ycbcr;

pub use decode::decode;
pub use encode::encode;
pub use general::Decoder;

/// The row-major position of the k-th coefficient in scan order, ITU-T T.81 figure A.6.
const ZIGZAG: [u8; 64] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20, 13, 6, 7, 14, 21,
    28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59, 52, 45, 38, 31, 39, 46, 53, 60, 61, 54,
    47, 55, 62, 63,
];
