#pragma once

// Files on Windows: reads and writes at offsets. Errors are exceptions.

#include <cstddef>

#include "base/span.h"

namespace v3dg {

// An open file, with the interface of PosixFile. File names are in UTF-8, as Python
// encodes them. Other programs may rename and delete the file while it is open. Errors
// throw std::system_error with the matching value of errno.
class WindowsFile {
  public:
    struct Piece {
        void* iov_base;
        size_t iov_len;
    };

    static WindowsFile open(const char* path);
    static WindowsFile create(const char* path);
    // Opens the file of a descriptor of the C runtime again, for reading. The original
    // may be closed afterwards.
    static WindowsFile duplicate(int descriptor);
    WindowsFile(WindowsFile&& other) noexcept;
    WindowsFile& operator=(WindowsFile&&) = delete;
    ~WindowsFile();

    size_t size() const;
    bool is_folder() const;
    bool is_regular() const;

    // Returns the number of bytes that were read. It is less than `size` only at the
    // end of the file.
    size_t read_at(size_t offset, char* bytes, size_t size) const;
    // Reads into pieces of memory, one after another. Returns the number of bytes that
    // were read.
    size_t read_at(size_t offset, Span<Piece> pieces) const;
    // Does nothing, because Windows reads ahead by itself.
    void expect(size_t /*offset*/, size_t /*size*/) const {}
    void write_at(size_t offset, const char* bytes, size_t size) const;
    // Closes the file. Some file systems only report a failed write now.
    void close();

  private:
    explicit WindowsFile(void* handle);

    void* handle_;
};

}  // namespace v3dg
