//! Packing of binary pixels, eight to the byte, the first in the most significant bit (`numpy.packbits`).

/// Packs one row; bits beyond the row's end are 0.
pub fn pack_row(pixels: &[u16], bytes: &mut [u8]) {
    for (byte, eight) in bytes.iter_mut().zip(pixels.chunks(8)) {
        *byte = eight.iter().enumerate().fold(0, |b, (i, &p)| b | u8::from(p > 0) << (7 - i));
    }
}

/// Unpacks one row of `pixels.len()` bits.
pub fn unpack_row(bytes: &[u8], pixels: &mut [u16]) {
    for (i, pixel) in pixels.iter_mut().enumerate() {
        *pixel = u16::from(bytes[i / 8] >> (7 - i % 8) & 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn first_pixel_is_the_highest_bit() {
        let mut bytes = [0u8; 2];
        pack_row(&[0, 0, 0, 0, 0, 0, 0, 1, 1, 1], &mut bytes);
        assert_eq!(bytes, [0x01, 0xc0]);
    }

    proptest! {
        #[test]
        fn unpacking_inverts_packing(row in prop::collection::vec(0u16..2, 1..200)) {
            let mut bytes = vec![0u8; row.len().div_ceil(8)];
            pack_row(&row, &mut bytes);
            let mut back = vec![0u16; row.len()];
            unpack_row(&bytes, &mut back);
            prop_assert_eq!(row, back);
        }
    }
}
