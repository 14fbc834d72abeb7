#pragma once

// Files by descriptor. `File` is the class of the operating system; it reads and writes
// at offsets.

#if defined(_WIN32)
#include "io/windows_file.h"
#else
#include "io/posix_file.h"
#endif

namespace v3dg {

#if defined(_WIN32)
using File = WindowsFile;
using FilePiece = WindowsFile::Piece;
#else
using File = PosixFile;
using FilePiece = iovec;
#endif

}  // namespace v3dg
