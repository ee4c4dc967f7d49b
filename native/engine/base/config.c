/* SPDX-License-Identifier: Apache-2.0
 *
 * Whether a guard's settings are valid: checked by the daemon before it sends them, and again by
 * the guard.
 */
#include <errno.h>

#include "base.h"

int config_check(const struct avc_config *config, struct avc_error *err)
{
	if (config->keep < 1 || config->keep > AVC_KEEP_MAX)
		return fail(err, AVC_CONFIG, EINVAL, 0, "configure guard", "",
			    "keep must be 1 to %d", AVC_KEEP_MAX);
	if (config->restore_max > AVC_RESTORES_MAX)
		return fail(err, AVC_CONFIG, EINVAL, 0, "configure guard", "",
			    "restore_max must be at most %d", AVC_RESTORES_MAX);
	if (config->images > AVC_IMAGES_AUTO)
		return fail(err, AVC_CONFIG, EINVAL, 0, "configure guard", "",
			    "images must be 0 to %d", AVC_IMAGES_AUTO);
	if (config->again & ~(AVC_AGAIN_DROP_INPUT | AVC_AGAIN_STAGGER))
		return fail(err, AVC_CONFIG, EINVAL, 0, "configure guard", "",
			    "again must be of AVC_AGAIN_DROP_INPUT and AVC_AGAIN_STAGGER");
	if (config->interval_min_ns > config->interval_ns ||
	    (config->interval_min_ns && (!config->budget_freeze_ppm || !config->budget_cpu_ppm)))
		return fail(err, AVC_CONFIG, EINVAL, 0, "configure guard", "",
			    "an automatic interval takes budgets, and its least is the smaller");
	return 0;
}
