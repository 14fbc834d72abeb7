#pragma once

// Files by descriptor: reads and writes at offsets. Errors are exceptions.

#include <cerrno>
#include <cstddef>
#include <system_error>

#include <fcntl.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

#include "base/span.h"

namespace v3dg {

// An open file. Each read and write has its own offset, so several threads can share
// the file. Errors throw std::system_error with the value of errno.
class PosixFile {
  public:
    static PosixFile open(const char* path) {
        // With O_NONBLOCK, opening a pipe does not wait for a writer. For regular
        // files, the flag has no effect.
        return PosixFile(::open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK));
    }
    static PosixFile create(const char* path) {
        return PosixFile(::open(path, O_WRONLY | O_CLOEXEC | O_CREAT | O_TRUNC, 0666));
    }
    // Duplicates the descriptor of an open file. The original may be closed afterwards.
    static PosixFile duplicate(int descriptor) {
        return PosixFile(::fcntl(descriptor, F_DUPFD_CLOEXEC, 0));
    }
    PosixFile(PosixFile&& other) noexcept : descriptor_(other.descriptor_) {
        other.descriptor_ = -1;
    }
    PosixFile& operator=(PosixFile&&) = delete;
    ~PosixFile() {
        if (descriptor_ >= 0) ::close(descriptor_);
    }

    size_t size() const { return static_cast<size_t>(status().st_size); }
    bool is_folder() const { return S_ISDIR(status().st_mode); }
    bool is_regular() const { return S_ISREG(status().st_mode); }

    // Returns the number of bytes that were read. It is less than `size` only at the
    // end of the file.
    size_t read_at(size_t offset, char* bytes, size_t size) const {
        iovec piece{bytes, size};
        return read_at(offset, Span<iovec>{&piece, 1});
    }

    // Reads into at most 1024 pieces of memory, one after another. Modifies `pieces`.
    // Returns the number of bytes that were read, as above.
    size_t read_at(size_t offset, Span<iovec> pieces) const {
        size_t done = 0;
        while (!pieces.empty()) {
            const ssize_t got = ::preadv(descriptor_, pieces.data, static_cast<int>(pieces.size),
                                         static_cast<off_t>(offset + done));
            if (got < 0 && errno == EINTR) continue;
            check(got);
            if (got == 0) break;
            done += static_cast<size_t>(got);
            size_t left = static_cast<size_t>(got);
            for (; !pieces.empty() && left >= pieces.data->iov_len; ++pieces.data, --pieces.size)
                left -= pieces.data->iov_len;
            if (left == 0) continue;
            pieces.data->iov_base = static_cast<char*>(pieces.data->iov_base) + left;
            pieces.data->iov_len -= left;
        }
        return done;
    }

    // Asks the system to start reading a part of the file. Some systems ignore the
    // request.
    void expect([[maybe_unused]] size_t offset, [[maybe_unused]] size_t size) const {
#ifdef POSIX_FADV_WILLNEED
        static_cast<void>(::posix_fadvise(descriptor_, static_cast<off_t>(offset),
                                          static_cast<off_t>(size), POSIX_FADV_WILLNEED));
#endif
    }

    void write_at(size_t offset, const char* bytes, size_t size) const {
        size_t done = 0;
        while (done < size) {
            const ssize_t put =
                ::pwrite(descriptor_, bytes + done, size - done, static_cast<off_t>(offset + done));
            if (put < 0 && errno == EINTR) continue;
            check(put);
            done += static_cast<size_t>(put);
        }
    }

    // Closes the file. Some file systems only report a failed write now.
    void close() {
        const int descriptor = descriptor_;
        descriptor_ = -1;
        check(::close(descriptor));
    }

  private:
    explicit PosixFile(int descriptor) : descriptor_(descriptor) { check(descriptor); }
    struct stat status() const {
        struct stat status = {};
        check(::fstat(descriptor_, &status));
        return status;
    }
    static void check(ssize_t result) {
        if (result < 0) throw std::system_error(errno, std::generic_category());
    }

    int descriptor_;
};

}  // namespace v3dg
