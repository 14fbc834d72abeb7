#include "io/blake2b.h"

#include <algorithm>
#include <cstring>

#include "io/blake2b_lanes.h"

namespace v3dg {

Blake2b::Blake2b() { std::copy(kHashStart, kHashStart + 8, state_); }

// BLAKE2b hashes the last block of a message differently, even if the block is full. So
// a full block is hashed only when more bytes follow.
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

void HashOfPieces::add_until(size_t end) {
    const size_t first = digests_.size();
    const size_t last = end < message_.size
                            ? end / kHashPieceBytes
                            : (message_.size + kHashPieceBytes - 1) / kHashPieceBytes;
    std::vector<Span<const uint8_t>> pieces;
    for (size_t i = first; i < last; ++i) {
        const size_t begin = i * kHashPieceBytes;
        pieces.push_back({message_.data + begin, std::min(kHashPieceBytes, message_.size - begin)});
    }
    digests_.resize(last);
    blake2b({pieces.data(), pieces.size()}, digests_.data() + first);
}

PageHash HashOfPieces::digest() {
    Blake2b hash;
    for (const PageHash& digest : digests_) hash.add(digest.data(), digest.size());
    return hash.digest();
}

}  // namespace v3dg
