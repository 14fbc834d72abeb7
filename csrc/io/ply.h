// 3D Gaussian Splatting .ply files, in the layout of the original 3DGS code.
//
// A file holds, for each gaussian, x y z, f_dc_0..2, f_rest_* (all red coefficients, then green,
// then blue), opacity (logit), scale_0..2 (log) and rot_0..3 (w x y z). Memory holds values:
// standard deviations and opacities in [0, 1], computed in double precision and rounded once.
//
// Source: Kerbl et al., 3D Gaussian Splatting, SIGGRAPH 2023, and the files of its code.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "base/span.h"
#include "io/ply_header.h"
#include "io/posix_file.h"

namespace v3dg {

// N gaussians with K = (degree + 1)^2 spherical harmonics a channel.
template <class T>
struct PlyGaussians {
    Span<T> means;      // [N * 3]
    Span<T> quats;      // [N * 4] w x y z
    Span<T> scales;     // [N * 3] standard deviations
    Span<T> opacities;  // [N]
    Span<T> sh;         // [N * K * 3]
};

// A gaussian, and the offset of its bytes, which only reading finds in text and in rows with lists.
struct PlyPlace {
    size_t row, offset;
};

// An opened file whose header, and its claims against the file's size, have been checked.
struct PlyFile {
    PosixFile file;
    size_t file_bytes;
    PlyEncoding encoding;
    PlyElement vertex;
    size_t vertex_offset;  // where the first gaussian's bytes begin
    size_t num_sh;         // K

    size_t num_gaussians() const { return vertex.count; }
    PlyPlace begin() const { return {0, vertex_offset}; }
};

// Throws std::system_error when the file cannot be read, PlyError when it is not a 3DGS file.
PlyFile open_ply(const char* path);

// Reads gaussians from `first` on, as many as `out` holds, and returns the place of the next one.
// `known` is the place of any gaussian; that of `first` is fastest. Quaternions are normalised,
// except those of length zero, those that are not finite, and those of length one up to rounding,
// so that reading what was written changes nothing. Needs a few megabytes beside `out`. Throws like
// open_ply; `out` is then partly written.
PlyPlace read_ply(const PlyFile& ply, size_t first, PlyPlace known, const PlyGaussians<float>& out);

// Creates `path`, which must not exist yet. Opacity 1 is written as logit 20, opacity 0 as logit
// -110, scale 0 as log -110: finite, and read back as exactly 1, 0 and 0. A comment is one line of
// the header. Throws std::system_error,
// or std::invalid_argument for a negative scale or an opacity outside [0, 1]; the file is then
// incomplete.
void write_ply(const char* path, const PlyGaussians<const float>& gaussians, PlyEncoding encoding,
               size_t num_sh, const std::vector<std::string>& comments = {});

}  // namespace v3dg
