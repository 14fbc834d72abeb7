// Reads and writes 3D Gaussian Splatting .ply files, in the layout of the original 3DGS
// code.
//
// A file has for each gaussian: x y z, f_dc_0..2, f_rest_* (all red coefficients, then
// green, then blue), opacity (logit), scale_0..2 (logarithms), rot_0..3 (w x y z). In
// memory, scales are standard deviations and opacities are in [0, 1]. They are computed
// in double precision and rounded once. PlyLayout describes the files of other
// trainers.
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

// The location of a gaussian: its index, and the offset of its bytes. In text, and if
// rows have lists, the offset is known only after reading the preceding rows.
struct PlyPlace {
    size_t row, offset;
};

// The location of a number in a row.
struct PlyField {
    // The property of a field that no row has.
    static constexpr size_t kNone = ~size_t(0);

    size_t property;  // index among the properties of the vertex element
    size_t offset;    // bytes from the start of the row, without lists
    PlyType type;
};

// The properties of a vertex that make a gaussian, and the differences from the files
// of the 3DGS code. Without scale_2, a gaussian is flat, as in 2DGS. Base colours in
// red, green and blue replace f_dc. filter_3D is the standard deviation of the filter
// that widens gaussians in Mip-Splatting.
struct PlyLayout {
    size_t num_sh = 1;  // K in memory; coefficients of higher degrees are not read
    bool is_flat = false;
    bool has_base_colors = false;
    bool has_filter = false;
    double color_scale[3] = {1, 1, 1};  // factor from stored base colours to [0, 1]
    std::string prefix;                 // of property names, before those of trainers
    std::vector<PlyField> fields;       // one per PlySlot
};

// An open file. Its header was checked, and the sizes in it were compared with the size
// of the file.
struct PlyFile {
    File file;
    size_t file_bytes;
    PlyEncoding encoding;
    PlyElement vertex;
    size_t vertex_offset;  // where the bytes of the first gaussian begin
    PlyLayout layout;

    size_t num_gaussians() const { return vertex.count; }
    PlyPlace begin() const { return {0, vertex_offset}; }
};

// Opens a file. Throws std::system_error if it cannot be read, and PlyError if it is
// not a 3DGS file.
PlyFile open_ply(const char* path);

// Reads gaussians from `first` on, as many as `out` has room for. Returns the place of
// the next gaussian. `known` is the place of any gaussian; reading is fastest if it is
// the place of `first`.
//
// Quaternions are normalised. Exceptions are quaternions that are zero, not finite, or
// have length 1 up to rounding, so that a file that was written here is read unchanged.
// Needs a few megabytes besides `out`. Throws like open_ply(); then `out` is partly
// written.
PlyPlace read_ply(const PlyFile& ply, size_t first, PlyPlace known, const PlyGaussians<float>& out);

// Writes gaussians to a new file; `path` must not exist yet. The logits of the
// opacities 1 and 0 are written as 20 and -110, and the logarithm of the scale 0 as
// -110. These finite numbers are read as exactly 1, 0 and 0. Each comment is one line
// of the header.
//
// Throws std::system_error if the file cannot be written, and std::invalid_argument if
// a scale is negative or an opacity is outside of [0, 1]. The file is then incomplete.
void write_ply(const char* path, const PlyGaussians<const float>& gaussians, PlyEncoding encoding,
               size_t num_sh, const std::vector<std::string>& comments = {});

}  // namespace v3dg
