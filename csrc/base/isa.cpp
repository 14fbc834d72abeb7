// Chooses the instruction set, once per process.

#include "base/isa.h"

#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

#if defined(_WIN32) && defined(__x86_64__)
#include <intrin.h>
#endif

namespace v3dg {

const char* isa_name(Isa isa) {
    switch (isa) {
        case Isa::avx512: return "avx512";
        case Isa::avx2: return "avx2";
        case Isa::baseline: break;
    }
    return "baseline";
}

#if defined(__x86_64__)

// The CPU features that compilers use with -march=x86-64-v3 and -march=x86-64-v4.
struct Extensions {
    bool v3, v4;
};

#if defined(_WIN32)
// On Windows, the C++ runtime does not support __builtin_cpu_supports(), so query the
// CPU directly. The operating system must also save the wide registers.
__attribute__((target("xsave"))) static Extensions extensions() {
    int basic[4], extended[4];
    __cpuid(basic, 0);
    if (basic[0] < 7) return {};
    __cpuid(basic, 1);
    __cpuidex(extended, 7, 0);
    const auto has = [](int flags, int bit) {
        return (static_cast<unsigned>(flags) >> bit & 1) != 0;
    };
    const bool has_xsave = has(basic[2], 27);
    const unsigned long long saved = has_xsave ? _xgetbv(0) : 0;
    const bool v3 = (saved & 0x6) == 0x6 && has(extended[1], 5) && has(basic[2], 12) &&
                    has(extended[1], 3) && has(extended[1], 8) && has(basic[2], 23);
    const bool v4 = v3 && (saved & 0xe6) == 0xe6 && has(extended[1], 16) && has(extended[1], 30) &&
                    has(extended[1], 28) && has(extended[1], 17) && has(extended[1], 31);
    return {v3, v4};
}
#else
static Extensions extensions() {
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                    __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") &&
                    __builtin_cpu_supports("popcnt");
    const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                    __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                    __builtin_cpu_supports("avx512vl");
    return {v3, v4};
}
#endif

static Isa widest_isa() {
    const Extensions present = extensions();
    if (present.v4) return Isa::avx512;
    if (present.v3) return Isa::avx2;
    return Isa::baseline;
}

#else

static Isa widest_isa() { return Isa::baseline; }

#endif

static Isa choose_isa() {
    const Isa widest = widest_isa();
    const char* wanted = std::getenv("V3DG_ISA");
    if (wanted == nullptr || *wanted == '\0') return widest;
    for (const Isa isa : {Isa::baseline, Isa::avx2, Isa::avx512}) {
        if (std::strcmp(wanted, isa_name(isa)) != 0) continue;
        if (isa > widest)
            throw std::runtime_error(std::string("V3DG_ISA: this processor does not support ") +
                                     wanted + "; use at most " + isa_name(widest));
        return isa;
    }
    throw std::runtime_error(std::string("V3DG_ISA: expected baseline, avx2 or avx512, got ") +
                             wanted);
}

Isa active_isa() {
    static const Isa isa = choose_isa();
    return isa;
}

}  // namespace v3dg
