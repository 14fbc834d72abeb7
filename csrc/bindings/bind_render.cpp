#include "bindings/args.h"

namespace v3dg {

void bind_render(py::module_&) {}

}  // namespace v3dg
