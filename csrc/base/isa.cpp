// Chooses the instruction set, once per process.

#include "base/isa.h"

#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

namespace v3dg {

const char* isa_name(Isa isa) {
    switch (isa) {
        case Isa::avx512: return "avx512";
        case Isa::avx2: return "avx2";
        case Isa::baseline: break;
    }
    return "baseline";
}

static Isa widest_isa() {
#if defined(__x86_64__)
    // The extensions that compilers use with -march=x86-64-v3 and -march=x86-64-v4.
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                    __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") &&
                    __builtin_cpu_supports("popcnt");
    const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                    __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                    __builtin_cpu_supports("avx512vl");
    if (v4) return Isa::avx512;
    if (v3) return Isa::avx2;
#endif
    return Isa::baseline;
}

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
