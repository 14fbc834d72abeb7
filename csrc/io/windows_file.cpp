// The position of the handle is not used: an offset is passed to each read and write
// (OVERLAPPED), so that several threads can share a file.

#if defined(_WIN32)

#include "io/windows_file.h"

#include <windows.h>

#include <io.h>
#include <algorithm>
#include <cerrno>
#include <string>
#include <system_error>

namespace v3dg {

namespace {

constexpr DWORD kShareAll = FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE;
// Maximum number of bytes of one system call.
constexpr size_t kMostBytes = size_t(1) << 30;

int errno_of(DWORD error) {
    switch (error) {
        case ERROR_FILE_NOT_FOUND:
        case ERROR_PATH_NOT_FOUND:
        case ERROR_INVALID_NAME:
        case ERROR_BAD_NETPATH: return ENOENT;
        case ERROR_ACCESS_DENIED:
        case ERROR_SHARING_VIOLATION:
        case ERROR_LOCK_VIOLATION: return EACCES;
        case ERROR_DISK_FULL:
        case ERROR_HANDLE_DISK_FULL: return ENOSPC;
        case ERROR_NOT_ENOUGH_MEMORY:
        case ERROR_OUTOFMEMORY: return ENOMEM;
        case ERROR_INVALID_HANDLE: return EBADF;
        case ERROR_WRITE_PROTECT: return EROFS;
        case ERROR_TOO_MANY_OPEN_FILES: return EMFILE;
        case ERROR_FILENAME_EXCED_RANGE: return ENAMETOOLONG;
        default: return EIO;
    }
}

[[noreturn]] void throw_errno(int error) {
    throw std::system_error(error, std::generic_category());
}
[[noreturn]] void throw_last_error() { throw_errno(errno_of(GetLastError())); }

std::wstring wide(const char* text) {
    const int size = MultiByteToWideChar(CP_UTF8, MB_ERR_INVALID_CHARS, text, -1, nullptr, 0);
    if (size <= 0) throw_errno(ENOENT);
    std::wstring name(static_cast<size_t>(size), L'\0');
    MultiByteToWideChar(CP_UTF8, 0, text, -1, name.data(), size);
    return name;
}

OVERLAPPED at(size_t offset) {
    OVERLAPPED place = {};
    place.Offset = static_cast<DWORD>(offset & 0xffffffffu);
    place.OffsetHigh = static_cast<DWORD>(static_cast<unsigned long long>(offset) >> 32);
    return place;
}

}  // namespace

WindowsFile::WindowsFile(void* handle) : handle_(handle) {
    if (handle == INVALID_HANDLE_VALUE) throw_last_error();
}

WindowsFile WindowsFile::open(const char* path) {
    // With FILE_FLAG_BACKUP_SEMANTICS, a folder can be opened, and is then rejected
    // with an error text that names it.
    return WindowsFile(CreateFileW(wide(path).c_str(), GENERIC_READ, kShareAll, nullptr,
                                   OPEN_EXISTING, FILE_FLAG_BACKUP_SEMANTICS, nullptr));
}

WindowsFile WindowsFile::create(const char* path) {
    return WindowsFile(CreateFileW(wide(path).c_str(), GENERIC_WRITE, kShareAll, nullptr,
                                   CREATE_ALWAYS, FILE_ATTRIBUTE_NORMAL, nullptr));
}

WindowsFile WindowsFile::duplicate(int descriptor) {
    const intptr_t handle = _get_osfhandle(descriptor);
    if (handle == -1 || handle == -2) throw_errno(EBADF);
    return WindowsFile(ReOpenFile(reinterpret_cast<HANDLE>(handle), GENERIC_READ, kShareAll, 0));
}

WindowsFile::WindowsFile(WindowsFile&& other) noexcept : handle_(other.handle_) {
    other.handle_ = INVALID_HANDLE_VALUE;
}

WindowsFile::~WindowsFile() {
    if (handle_ != INVALID_HANDLE_VALUE) CloseHandle(handle_);
}

size_t WindowsFile::size() const {
    LARGE_INTEGER size;
    if (!GetFileSizeEx(handle_, &size)) throw_last_error();
    return static_cast<size_t>(size.QuadPart);
}

bool WindowsFile::is_folder() const {
    BY_HANDLE_FILE_INFORMATION information;
    return GetFileInformationByHandle(handle_, &information) &&
           (information.dwFileAttributes & FILE_ATTRIBUTE_DIRECTORY) != 0;
}

bool WindowsFile::is_regular() const {
    return GetFileType(handle_) == FILE_TYPE_DISK && !is_folder();
}

size_t WindowsFile::read_at(size_t offset, char* bytes, size_t size) const {
    size_t done = 0;
    while (done < size) {
        OVERLAPPED place = at(offset + done);
        DWORD got = 0;
        const auto wanted = static_cast<DWORD>(std::min(size - done, kMostBytes));
        if (!ReadFile(handle_, bytes + done, wanted, &got, &place)) {
            if (GetLastError() == ERROR_HANDLE_EOF) break;
            throw_last_error();
        }
        if (got == 0) break;
        done += got;
    }
    return done;
}

size_t WindowsFile::read_at(size_t offset, Span<Piece> pieces) const {
    size_t done = 0;
    for (const Piece& piece : pieces) {
        const size_t got =
            read_at(offset + done, static_cast<char*>(piece.iov_base), piece.iov_len);
        done += got;
        if (got < piece.iov_len) break;
    }
    return done;
}

void WindowsFile::write_at(size_t offset, const char* bytes, size_t size) const {
    size_t done = 0;
    while (done < size) {
        OVERLAPPED place = at(offset + done);
        DWORD put = 0;
        const auto wanted = static_cast<DWORD>(std::min(size - done, kMostBytes));
        if (!WriteFile(handle_, bytes + done, wanted, &put, &place)) throw_last_error();
        done += put;
    }
}

void WindowsFile::close() {
    const HANDLE handle = handle_;
    handle_ = INVALID_HANDLE_VALUE;
    if (!CloseHandle(handle)) throw_last_error();
}

}  // namespace v3dg

#endif  // _WIN32
