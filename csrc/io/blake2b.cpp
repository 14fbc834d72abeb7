#include "io/blake2b.h"

#include <algorithm>
#include <cstring>

#include "io/blake2b_lanes.h"

namespace v3dg {

Blake2b::Blake2b() { std::copy(kHashStart, kHashStart + 8, state_); }

// The last block, full or not, is hashed otherwise than the others: it waits until more comes.
void Blake2b::add(const unsigned char* bytes, size_t size) {
    const auto take = [&](size_t count) {
        if (count > 0) std::memcpy(waiting_ + num_waiting_, bytes, count);
        num_waiting_ += count;
        bytes += count;
        size -= count;
    };
    const auto add_whole = [&](const unsigned char* blocks, size_t count) {
        V3DG_DISPATCH_ISA(add_blocks, state_, num_bytes_, blocks, count);
        num_bytes_ += count * kHashBlockBytes;
    };
    if (num_waiting_ > 0) take(std::min(size, kHashBlockBytes - num_waiting_));
    if (size == 0) return;
    if (num_waiting_ > 0) add_whole(waiting_, 1);
    num_waiting_ = 0;
    const size_t count = (size - 1) / kHashBlockBytes;
    add_whole(bytes, count);
    bytes += count * kHashBlockBytes;
    size -= count * kHashBlockBytes;
    take(size);
}

PageHash Blake2b::digest() {
    std::fill(waiting_ + num_waiting_, waiting_ + kHashBlockBytes, uint8_t{0});
    V3DG_DISPATCH_ISA(add_last_block, state_, num_bytes_ + num_waiting_, waiting_);
    PageHash digest;
    std::memcpy(digest.data(), state_, digest.size());
    return digest;
}

void blake2b(Span<const Span<const uint8_t>> messages, PageHash* digests) {
    V3DG_DISPATCH_ISA(hash_messages, messages, digests);
}

}  // namespace v3dg
