// Reads and writes 3D Gaussian Splatting .ply files, in the layout of the original 3DGS
// code.
//
// For each gaussian, a file has x y z, f_dc_0..2, f_rest_* (all red coefficients, then
// green, then blue), opacity (a logit), scale_0..2 (logarithms), and rot_0..3 (w x y
// z). In memory, scales are standard deviations, and opacities are in [0, 1]. They are
// computed in double precision and rounded once. PlyLayout describes how the files of
// other trainers differ.
//
// Source: Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023, and the files of its
// code.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "base/span.h"
#include "io/file.h"
#include "io/ply_header.h"

namespace v3dg {

// N gaussians with K = (degree + 1)^2 SH coefficients per channel.
template <class T>
struct PlyGaussians {
    Span<T> means;      // [N * 3]
    Span<T> quats;      // [N * 4] w x y z
    Span<T> scales;     // [N * 3] standard deviations
    Span<T> opacities;  // [N]
    Span<T> sh;         // [N * K * 3]
};

// The location of a gaussian: its index, and the offset of its bytes. In text files,
// and if rows have lists, the offset is only known after the rows before it have been
// read.
struct PlyPlace {
    size_t row, offset;
};

// The location of a number in a row.
struct PlyField {
    // The property of a field that rows do not have.
    static constexpr size_t kNone = ~size_t(0);

    size_t property;  // index among the properties of the vertex element
    size_t offset;    // bytes from the start of the row, without lists
    PlyType type;
};

// The properties of a vertex that make a gaussian, and how they differ from the files
// of the 3DGS code. If scale_2 is missing, a gaussian is flat, as in 2DGS. Base colours
// in red, green and blue replace f_dc. filter_3D is the standard deviation of the
// filter that widens gaussians in Mip-Splatting.
struct PlyLayout {
    size_t num_sh = 1;  // K in memory; coefficients of higher degrees are not read
    bool is_flat = false;
    bool has_base_colors = false;
    bool has_filter = false;
    double color_scale[3] = {1, 1, 1};  // factor from stored base colours to [0, 1]
    std::string prefix;            // prefix of property names, before the names that trainers use
    std::vector<PlyField> fields;  // one per PlySlot
};

// An open file. Its header has been checked, and the sizes in it agree with the size of
// the file.
struct PlyFile {
    File file;
    size_t file_bytes;
    PlyEncoding encoding;
    PlyElement vertex;
    size_t vertex_offset;  // offset of the first gaussian's bytes
    PlyLayout layout;

    size_t num_gaussians() const { return vertex.count; }
    PlyPlace begin() const { return {0, vertex_offset}; }
};

// Opens a file. Throws std::system_error if it cannot be read, and PlyError if it is
// not a 3DGS file.
PlyFile open_ply(const char* path);

// Reads as many gaussians as `out` has room for, beginning at `first`. Returns the
// place of the next gaussian. `known` is the place of any gaussian; the place of
// `first` makes reading fastest.
//
// Quaternions are normalised, unless they are zero, not finite, or have length 1 up to
// rounding. Therefore a file that was written here is read unchanged. This function
// needs a few megabytes in addition to `out`. It throws like open_ply(); `out` is then
// incomplete.
PlyPlace read_ply(const PlyFile& ply, size_t first, PlyPlace known, const PlyGaussians<float>& out);

// Writes gaussians to a new file; `path` must not exist. Infinite values are replaced:
// the logits of the opacities 1 and 0 are written as 20 and -110, and the logarithm of
// the scale 0 as -110. When read, these numbers give exactly 1, 0 and 0. Each comment
// is one line of the header.
//
// Throws std::system_error if the file cannot be written, and std::invalid_argument if
// a scale is negative or an opacity is outside [0, 1]. The file is then incomplete.
void write_ply(const char* path, const PlyGaussians<const float>& gaussians, PlyEncoding encoding,
               size_t num_sh, const std::vector<std::string>& comments = {});

}  // namespace v3dg
