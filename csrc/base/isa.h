#pragma once

// For sources that are compiled once per instruction set: the choice of the instruction
// set at run time.

namespace v3dg {

// The instruction sets for which the sources in V3DG_SIMD_SOURCES are compiled.
enum class Isa { baseline, avx2, avx512 };

// Returns the instruction set that the environment variable V3DG_ISA names or, without
// it, the widest one of this processor. The variable is read once. Throws
// std::runtime_error if its value is invalid, or if the processor does not support that
// instruction set.
Isa active_isa();
const char* isa_name(Isa isa);

}  // namespace v3dg

// V3DG_DECLARE_PER_ISA repeats a declaration in the namespace of each instruction set.
// V3DG_DISPATCH_ISA calls the version for active_isa().
#if defined(__x86_64__)
#define V3DG_DECLARE_PER_ISA(...)           \
    namespace isa_baseline { __VA_ARGS__; } \
    namespace isa_avx2 { __VA_ARGS__; }     \
    namespace isa_avx512 { __VA_ARGS__; }
#define V3DG_DISPATCH_ISA(function, ...)                                                     \
    (::v3dg::active_isa() == ::v3dg::Isa::avx512 ? ::v3dg::isa_avx512::function(__VA_ARGS__) \
     : ::v3dg::active_isa() == ::v3dg::Isa::avx2 ? ::v3dg::isa_avx2::function(__VA_ARGS__)   \
                                                 : ::v3dg::isa_baseline::function(__VA_ARGS__))
#else
#define V3DG_DECLARE_PER_ISA(...) \
    namespace isa_baseline { __VA_ARGS__; }
#define V3DG_DISPATCH_ISA(function, ...) ::v3dg::isa_baseline::function(__VA_ARGS__)
#endif
