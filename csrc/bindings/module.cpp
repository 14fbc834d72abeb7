#include "base/isa.h"
#include "bindings/args.h"
#include "project/project_math.h"

PYBIND11_MODULE(_core, m) {
    m.doc() = "Compiled operations of v3dg; the public interface is the package v3dg.";
    m.attr("reach_sigmas") = v3dg::kReachSigmas;
    m.attr("has_cuda") = V3DG_WITH_CUDA != 0;
    m.def(
        "isa", [] { return v3dg::isa_name(v3dg::active_isa()); },
        "Instruction set that the CPU half runs on.");
    v3dg::bind_box(m);
    v3dg::bind_cluster(m);
    v3dg::bind_gather(m);
    v3dg::bind_select(m);
    v3dg::bind_simplify_init(m);
    v3dg::bind_ply(m);
    v3dg::bind_render(m);
    v3dg::bind_rasterize_cuda(m);
    v3dg::bind_fit_level(m);
    v3dg::bind_loss(m);
    v3dg::bind_frame(m);
}
