#pragma once

// Sources that are compiled once for each instruction set, and the choice between their
// versions.

namespace v3dg {

// The instruction sets that the sources in V3DG_SIMD_SOURCES are compiled for.
enum class Isa { baseline, avx2, avx512 };

// Returns the widest instruction set that this processor has, or the one that the
// environment variable V3DG_ISA names, which is read once. Throws std::runtime_error
// when the variable names an instruction set that the processor lacks.
Isa active_isa();
const char* isa_name(Isa isa);

}  // namespace v3dg

// Repeats a declaration in each instruction set's namespace.
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
