#include "base/parallel_for.h"
#include "project/ellipses.h"

namespace v3dg {

template <class T>
void cpu::ellipses(const EllipsesInput<T>& in, const Ellipses<T>& out) {
    parallel_for(in.rows.size, 1024, [&](size_t i) { in.write(i, out); });
}

template void cpu::ellipses<float>(const EllipsesInput<float>&, const Ellipses<float>&);
template void cpu::ellipses<double>(const EllipsesInput<double>&, const Ellipses<double>&);

}  // namespace v3dg
