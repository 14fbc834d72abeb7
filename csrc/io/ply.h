// 3D Gaussian Splatting .ply files, in the layout of the original 3DGS code.
//
// A file holds, for each gaussian, x y z, f_dc_0..2, f_rest_* (all red coefficients,
// then green, then blue), opacity (logit), scale_0..2 (log) and rot_0..3 (w x y z).
// Memory holds values: standard deviations and opacities in [0, 1], computed in double
// precision and rounded once. What other trainers write differently is in PlyLayout.
//
// Source: Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023, and the files of its
// code.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "base/span.h"
#include "io/ply_header.h"
#include "io/posix_file.h"

namespace v3dg {

// N gaussians with K = (degree + 1)^2 spherical harmonics per channel.
template <class T>
struct PlyGaussians {
    Span<T> means;      // [N * 3]
    Span<T> quats;      // [N * 4] w x y z
    Span<T> scales;     // [N * 3] standard deviations
    Span<T> opacities;  // [N]
    Span<T> sh;         // [N * K * 3]
};

// A gaussian, and the offset of its bytes. For text and for rows with lists, the offset
// is known only after reading.
struct PlyPlace {
    size_t row, offset;
};

// Where in a row a number is.
struct PlyField {
    static constexpr size_t kNone = ~size_t(0);  // the property of what no row has

    size_t property;  // among the properties of the vertex element
    size_t offset;    // bytes from the start of the row, without lists
    PlyType type;
};

// How the properties of a vertex make a gaussian: the slots that they fill, and what is
// otherwise than in the files of the 3DGS code. A row without scale_2 is a flat
// gaussian, as 2DGS has them; red, green and blue stand for f_dc where a trainer writes
// base colours; filter_3D is the standard deviation of the filter by which
// Mip-Splatting widens a gaussian.
struct PlyLayout {
    size_t num_sh = 1;  // K; coefficients of higher degrees in the file are not read
    bool is_flat = false;
    bool has_base_colors = false;
    bool has_filter = false;
    double color_scale[3] = {1, 1, 1};  // from a stored base colour to one of 0 to 1
    std::string prefix;                 // of the names of properties, before trainers' names
    std::vector<PlyField> fields;       // of each PlySlot
};

// An opened file whose header, and its claims against the file's size, have been
// checked.
struct PlyFile {
    PosixFile file;
    size_t file_bytes;
    PlyEncoding encoding;
    PlyElement vertex;
    size_t vertex_offset;  // where the first gaussian's bytes begin
    PlyLayout layout;

    size_t num_gaussians() const { return vertex.count; }
    PlyPlace begin() const { return {0, vertex_offset}; }
};

// Throws std::system_error when the file cannot be read, PlyError when it is not a 3DGS
// file.
PlyFile open_ply(const char* path);

// Reads gaussians from `first` on, as many as `out` has room for, and returns the place
// of the next one. `known` is the place of any gaussian; that of `first` is fastest.
// Quaternions are normalised, except those of length zero, those that are not finite,
// and those of length one up to rounding; so reading preserves a file that was written
// before. Needs a few megabytes besides `out`. Throws like open_ply; `out` is then
// partly written.
PlyPlace read_ply(const PlyFile& ply, size_t first, PlyPlace known, const PlyGaussians<float>& out);

// Creates `path`, which must not exist yet. Opacity 1 is written as logit 20, opacity 0
// as logit -110, scale 0 as log -110: these are finite, and are read as exactly 1, 0
// and 0. Each comment is one line of the header. Throws std::system_error, or
// std::invalid_argument for a negative scale or an opacity outside [0, 1]; the file is
// then incomplete.
void write_ply(const char* path, const PlyGaussians<const float>& gaussians, PlyEncoding encoding,
               size_t num_sh, const std::vector<std::string>& comments = {});

}  // namespace v3dg
