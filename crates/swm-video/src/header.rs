//! The parameters of a decoder that the header of a file states.

use crate::mp4::{Codec, Colours, Index};
use ffmpeg_next::color::{Range, Space};
use ffmpeg_next::{codec, ffi};

/// The matrix with a number of ISO/IEC 23091-2.
const fn space(number: u16) -> Option<Space> {
    Some(match number {
        0 => Space::RGB,
        1 => Space::BT709,
        4 => Space::FCC,
        5 => Space::BT470BG,
        6 => Space::SMPTE170M,
        7 => Space::SMPTE240M,
        9 => Space::BT2020NCL,
        10 => Space::BT2020CL,
        _ => return None,
    })
}

/// Passes the codec parameters from the file's header to a decoder that is not open yet.
#[allow(unsafe_code, reason = "sets fields of FFmpeg's context that `ffmpeg-next` does not offer")]
pub fn set(context: &mut codec::Context, index: &Index) {
    let bytes = &index.extradata;
    let sides = (i32::try_from(index.width), i32::try_from(index.height));
    let (Ok(length), (Ok(width), Ok(height))) = (i32::try_from(bytes.len()), sides) else { return };
    // `ffmpeg-next` sets these only when libavformat, whose parsers must not read damaged files, opens the file.
    // SAFETY: the memory comes from FFmpeg's allocator, has the zeroed padding that decoders read, is filled within its
    // length, and then belongs to the context, which frees it. The context is not open yet and has no extradata.
    unsafe {
        let context = context.as_mut_ptr();
        // Decoders replace these by what a stream states.
        if let Some(Colours { matrix, full }) = index.colours {
            if let Some(space) = space(matrix) {
                (*context).colorspace = space.into();
            }
            if let Some(full) = full {
                (*context).color_range = if full { Range::JPEG } else { Range::MPEG }.into();
            }
        }
        // Streams of the other codecs state the size of their frames themselves.
        if index.codec == Codec::Ffv1 {
            ((*context).width, (*context).height) = (width, height);
        }
        if bytes.is_empty() {
            return;
        }
        let memory = ffi::av_mallocz(bytes.len() + ffi::AV_INPUT_BUFFER_PADDING_SIZE as usize).cast::<u8>();
        if memory.is_null() {
            return;
        }
        std::ptr::copy_nonoverlapping(bytes.as_ptr(), memory, bytes.len());
        (*context).extradata = memory;
        (*context).extradata_size = length;
    }
}
