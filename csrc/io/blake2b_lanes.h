#pragma once

// The compression function of BLAKE2b for each instruction set, both for one message
// and for several messages in parallel.

#include <cstddef>
#include <cstdint>

#include "base/isa.h"
#include "base/span.h"
#include "io/blake2b.h"

namespace v3dg {

constexpr uint64_t kHashConstant[8] = {0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b,
                                       0xa54ff53a5f1d36f1, 0x510e527fade682d1, 0x9b05688c2b3e6c1f,
                                       0x1f83d9abfb41bd6b, 0x5be0cd19137e2179};
// The initial state for digests of kPageHashBytes bytes and no key.
constexpr uint64_t kHashStart[8] = {kHashConstant[0] ^ 0x01010000 ^ kPageHashBytes,
                                    kHashConstant[1],
                                    kHashConstant[2],
                                    kHashConstant[3],
                                    kHashConstant[4],
                                    kHashConstant[5],
                                    kHashConstant[6],
                                    kHashConstant[7]};

V3DG_DECLARE_PER_ISA(
    // Adds whole blocks to the state. The last block of the message must not be among
    // them. `num_bytes` is the number of bytes that were added before.
    void add_blocks(uint64_t* state, uint64_t num_bytes, const unsigned char* blocks,
                    size_t num_blocks);
    // Adds the last block, padded with zeros. `num_bytes` is the size of the whole
    // message.
    void add_last_block(uint64_t* state, uint64_t num_bytes, const unsigned char* block);
    void hash_messages(Span<const Span<const uint8_t>> messages, PageHash* digests);)

}  // namespace v3dg
