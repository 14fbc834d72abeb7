#include "io/hashed_read.h"

#include <algorithm>
#include <utility>

namespace v3dg {

namespace {

constexpr size_t kPieceBytes = size_t(1) << 20;
constexpr size_t kPiecesAhead = 8;                  // that the disk is asked for together
constexpr size_t kLargeBytes = 4 * kPieceBytes;     // what is worth two threads
constexpr size_t kNeededBefore = size_t(64) << 10;  // of the coarsest page, which is in front of the tables

}  // namespace

HashedRead::HashedRead(PosixFile file, Span<const uint8_t> before, size_t offset, Span<uint8_t> bytes)
    : file_(std::move(file)), before_(before), offset_(offset), bytes_(bytes) {
    const size_t first = offset - std::min(offset, kNeededBefore);
    file_.expect(first, offset - first + std::min(bytes.size, kPieceBytes));
    const auto how = bytes.size < kLargeBytes ? std::launch::deferred : std::launch::async;
    read_ = std::async(how, [this] { return read(); }).share();
    hash_ = std::async(how, [this] { return hash(); });
}

bool HashedRead::read() {
    bool is_whole = true;
    std::exception_ptr error;
    size_t expected = 0;
    try {
        for (size_t done = 0; done < bytes_.size && is_whole; done += kPieceBytes) {
            for (; expected < std::min(bytes_.size, done + kPiecesAhead * kPieceBytes);
                 expected += kPieceBytes)
                file_.expect(offset_ + expected, std::min(kPieceBytes, bytes_.size - expected));
            const size_t size = std::min(kPieceBytes, bytes_.size - done);
            is_whole =
                file_.read_at(offset_ + done, reinterpret_cast<char*>(bytes_.data) + done, size) == size;
            const std::lock_guard<std::mutex> lock(busy_);
            num_read_ = done + size;
            has_more_.notify_one();
        }
    } catch (const std::system_error&) {
        error = std::current_exception();
    }
    {
        const std::lock_guard<std::mutex> lock(busy_);
        is_over_ = true;
        has_more_.notify_one();
    }
    if (error) std::rethrow_exception(error);
    return is_whole;
}

size_t HashedRead::wait_for_more(size_t than) {
    std::unique_lock<std::mutex> lock(busy_);
    has_more_.wait(lock, [&] { return is_over_ || num_read_ > than; });
    return num_read_;
}

PageHash HashedRead::hash() {
    Blake2b hash;
    hash.add(before_.data, before_.size);
    for (size_t done = 0; done < bytes_.size;) {
        const size_t end = wait_for_more(done);
        if (end == done) break;  // the file ended, of which wait() tells
        hash.add(bytes_.data + done, end - done);
        done = end;
    }
    return hash.digest();
}

PageHash HashedRead::digest() {
    read_.wait();
    return hash_.get();
}

}  // namespace v3dg
