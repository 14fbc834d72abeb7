#pragma once

// The binary rows of a .ply file. Rows of fixed size are read and converted by all
// threads, each in separate blocks. Rows with lists are separated by one thread and
// converted by all.

#include <cstddef>

#include "io/ply.h"

namespace v3dg {

// Read the gaussians from `begin` on, as many as `out` has room for, and return the
// place of the next one. Throw PlyError and std::system_error.
PlyPlace read_fixed_rows(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out);
PlyPlace read_rows_with_lists(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out);

// Returns the offset behind an element with lists that begins at `offset`. Throws
// likewise.
size_t skip_rows_with_lists(const PlyFile& ply, const PlyElement& element, size_t offset);

}  // namespace v3dg
