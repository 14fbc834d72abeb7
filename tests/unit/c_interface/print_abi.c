/* Prints the sizes of the structs of v3dg.h, the offsets of their fields, and constants. */

#include <stddef.h>
#include <stdio.h>

#include <v3dg.h>

#define STRUCT(type) printf("%s %zu\n", #type, sizeof(type))
#define FIELD(type, name) \
    printf("%s.%s %zu %zu\n", #type, #name, offsetof(type, name), sizeof(((type*)0)->name))
#define CONSTANT(name) printf("%s %d\n", #name, (int)name)

int main(void) {
    CONSTANT(V3DG_ABI_VERSION);
    STRUCT(v3dg_status);
    CONSTANT(V3DG_OK);
    CONSTANT(V3DG_ERROR_ARGUMENT);
    CONSTANT(V3DG_ERROR_FILE);
    CONSTANT(V3DG_ERROR_SYSTEM);
    CONSTANT(V3DG_ERROR_BUDGET);
    CONSTANT(V3DG_ERROR_MEMORY);
    CONSTANT(V3DG_ERROR_INTERNAL);
    STRUCT(v3dg_lens);
    CONSTANT(V3DG_PINHOLE);
    CONSTANT(V3DG_OPENCV);
    CONSTANT(V3DG_FISHEYE);
    STRUCT(v3dg_scene_info);
    FIELD(v3dg_scene_info, num_instances);
    FIELD(v3dg_scene_info, num_bundles);
    FIELD(v3dg_scene_info, num_cameras);
    STRUCT(v3dg_bundle_info);
    FIELD(v3dg_bundle_info, num_gaussians);
    FIELD(v3dg_bundle_info, num_page_bytes);
    FIELD(v3dg_bundle_info, most_page_bytes);
    FIELD(v3dg_bundle_info, num_clusters);
    FIELD(v3dg_bundle_info, num_groups);
    FIELD(v3dg_bundle_info, num_pages);
    FIELD(v3dg_bundle_info, num_levels);
    FIELD(v3dg_bundle_info, sh_degree);
    FIELD(v3dg_bundle_info, is_quantized);
    FIELD(v3dg_bundle_info, version);
    STRUCT(v3dg_page_info);
    FIELD(v3dg_page_info, offset);
    FIELD(v3dg_page_info, num_bytes);
    FIELD(v3dg_page_info, first_gaussian);
    FIELD(v3dg_page_info, num_gaussians);
    FIELD(v3dg_page_info, first_cluster);
    FIELD(v3dg_page_info, num_clusters);
    FIELD(v3dg_page_info, parent);
    FIELD(v3dg_page_info, level);
    STRUCT(v3dg_instance);
    FIELD(v3dg_instance, position);
    FIELD(v3dg_instance, quaternion);
    FIELD(v3dg_instance, scale);
    FIELD(v3dg_instance, bundle);
    FIELD(v3dg_instance, environment);
    FIELD(v3dg_instance, importance);
    FIELD(v3dg_instance, opacity);
    FIELD(v3dg_instance, tint);
    STRUCT(v3dg_camera);
    FIELD(v3dg_camera, viewmat);
    FIELD(v3dg_camera, fx);
    FIELD(v3dg_camera, fy);
    FIELD(v3dg_camera, cx);
    FIELD(v3dg_camera, cy);
    FIELD(v3dg_camera, near_depth);
    FIELD(v3dg_camera, distortion);
    FIELD(v3dg_camera, width);
    FIELD(v3dg_camera, height);
    FIELD(v3dg_camera, lens);
    STRUCT(v3dg_rule);
    FIELD(v3dg_rule, tolerance_px2);
    FIELD(v3dg_rule, fade);
    FIELD(v3dg_rule, budget);
    FIELD(v3dg_rule, min_level);
    FIELD(v3dg_rule, culls);
    STRUCT(v3dg_pair);
    FIELD(v3dg_pair, instance);
    FIELD(v3dg_pair, cluster);
    FIELD(v3dg_pair, page);
    FIELD(v3dg_pair, first_in_page);
    FIELD(v3dg_pair, num_gaussians);
    FIELD(v3dg_pair, weight);
    FIELD(v3dg_pair, filter_px2);
    FIELD(v3dg_pair, is_antialiased);
    STRUCT(v3dg_missing_page);
    FIELD(v3dg_missing_page, bundle);
    FIELD(v3dg_missing_page, page);
    FIELD(v3dg_missing_page, priority);
    STRUCT(v3dg_cut);
    FIELD(v3dg_cut, pairs);
    FIELD(v3dg_cut, num_pairs);
    FIELD(v3dg_cut, num_gaussians);
    FIELD(v3dg_cut, missing);
    FIELD(v3dg_cut, num_missing);
    FIELD(v3dg_cut, revision);
    FIELD(v3dg_cut, tolerance_px2);
    STRUCT(v3dg_gaussians);
    FIELD(v3dg_gaussians, means);
    FIELD(v3dg_gaussians, quaternions);
    FIELD(v3dg_gaussians, scales);
    FIELD(v3dg_gaussians, opacities);
    FIELD(v3dg_gaussians, sh);
    FIELD(v3dg_gaussians, capacity);
    FIELD(v3dg_gaussians, sh_degree);
    return 0;
}
