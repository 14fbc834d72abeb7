/* Counts the clusters and gaussians of a cut: v3dg_count FILE [TOLERANCE [BUDGET]]
 *
 * FILE is a bundle (.v3dg) or a scene (.json). The camera is the first one of the scene's
 * file, or else one that is three units from the origin. Nothing is drawn. */

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include <v3dg.h>

static int failed(void) {
    fprintf(stderr, "%s\n", v3dg_last_error());
    return 1;
}

/* Writes the first camera of the file, or one that looks at the origin. */
static v3dg_status find_camera(const v3dg_scene* scene, v3dg_camera* camera) {
    const double eye[3] = {0, -3, 0.5};
    const double target[3] = {0, 0, 0};
    const double up[3] = {0, 0, 1};
    v3dg_scene_info info;
    const v3dg_status status = v3dg_get_scene_info(scene, &info);
    if (status != V3DG_OK) return status;
    if (info.num_cameras > 0) return v3dg_get_camera(scene, 0, camera, NULL);
    return v3dg_look_at(eye, target, up, 0.8, 1280, 720, 0.01, camera);
}

/* Prints how many clusters and gaussians of each level of the first bundle a cut contains. */
static v3dg_status print_levels(const v3dg_scene* scene, const v3dg_cut* cut) {
    v3dg_bundle_info bundle;
    uint64_t* counts; /* clusters and gaussians of each level */
    v3dg_status status = v3dg_get_bundle_info(scene, 0, &bundle);
    if (status != V3DG_OK) return status;
    counts = calloc(bundle.num_levels + 1, 2 * sizeof *counts);
    if (counts == NULL) abort();
    for (uint64_t i = 0; i < cut->num_pairs && status == V3DG_OK; ++i) {
        v3dg_page_info page;
        status = v3dg_get_page_info(scene, 0, cut->pairs[i].page, &page);
        if (status != V3DG_OK) break;
        counts[2 * page.level] += 1;
        counts[2 * page.level + 1] += cut->pairs[i].num_gaussians;
    }
    for (uint32_t level = 0; level < bundle.num_levels; ++level)
        if (counts[2 * level] > 0)
            printf("level %" PRIu32 ": %" PRIu64 " clusters, %" PRIu64 " gaussians\n", level,
                   counts[2 * level], counts[2 * level + 1]);
    free(counts);
    return status;
}

int main(int num_arguments, char** arguments) {
    v3dg_scene* scene = NULL;
    v3dg_scene_info info;
    v3dg_camera camera;
    v3dg_rule rule = V3DG_DEFAULT_RULE;
    v3dg_cut* cut = NULL;

    if (num_arguments < 2) {
        fprintf(stderr, "usage: %s FILE [TOLERANCE [BUDGET]]\n", arguments[0]);
        return 2;
    }
    if (num_arguments > 2) rule.tolerance_px2 = atof(arguments[2]);
    if (num_arguments > 3) rule.budget = strtoull(arguments[3], NULL, 10);
    if (v3dg_open(arguments[1], &scene) != V3DG_OK) return failed();
    if (v3dg_get_scene_info(scene, &info) != V3DG_OK) return failed();
    if (find_camera(scene, &camera) != V3DG_OK) return failed();
    if (v3dg_select(scene, &camera, 1, &rule, &cut) != V3DG_OK) return failed();
    printf("%" PRIu64 " instances of %" PRIu32 " bundles: %" PRIu64 " clusters, %" PRIu64
           " gaussians at a tolerance of %g px2\n",
           info.num_instances, info.num_bundles, cut->num_pairs, cut->num_gaussians,
           cut->tolerance_px2);
    if (info.num_bundles == 1 && print_levels(scene, cut) != V3DG_OK) return failed();
    v3dg_free_cut(cut);
    v3dg_close(scene);
    return 0;
}
