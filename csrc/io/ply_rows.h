#pragma once

// Reads the binary rows of a .ply file. Rows of fixed size are read and converted by
// all threads, each of which reads its own blocks. Rows with lists are separated by one
// thread, and converted by all threads.

#include <cstddef>

#include "io/ply.h"

namespace v3dg {

// Read as many gaussians as `out` has room for, beginning at `begin`. Return the place
// of the next gaussian. Throw PlyError and std::system_error.
PlyPlace read_fixed_rows(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out);
PlyPlace read_rows_with_lists(const PlyFile& ply, PlyPlace begin, const PlyGaussians<float>& out);

// Returns the offset of the end of an element that has lists and begins at `offset`.
// Throws PlyError and std::system_error.
size_t skip_rows_with_lists(const PlyFile& ply, const PlyElement& element, size_t offset);

}  // namespace v3dg
