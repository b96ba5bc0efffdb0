"""What the tables show: the metrics of each protocol in order, with decimals and which way is better."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Metric:
    """How a metric is shown: title, decimals, which way is better ("max", "min", "one" = nearest 1), and a factor."""

    title: str
    digits: int
    better: Literal["", "max", "min", "one"] = ""
    scale: float = 1.0


_PSNR, _SSIM = Metric("PSNR3D (dB)", 2, "max"), Metric("SSIM3D", 3, "max")

COLUMNS: dict[str, dict[str, Metric]] = {
    "tissue": {"psnr3d": _PSNR, "ssim3d": _SSIM},
    "aligned": {"psnr3d": _PSNR, "ssim3d": _SSIM, "gain": Metric("gain", 3)},
    "aligned_50kev": {"psnr3d": _PSNR, "ssim3d": _SSIM, "gain": Metric("gain", 3)},
    "paper": {
        "psnr3d": _PSNR,
        "ssim3d": _SSIM,
        "psnr3d_full_gtmax": Metric("psnr3d_full_gtmax", 2, "max"),
        "psnr3d_r2": Metric("psnr3d_r2", 2, "max"),
        "ssim3d_r2": Metric("ssim3d_r2", 3, "max"),
        "ssim3d_naf": Metric("ssim3d_naf", 3, "max"),
    },
    "metal": {
        "core_ratio": Metric("core ratio", 3, "one"),
        "dice": Metric("Dice", 3, "max"),
        "boundary_rms": Metric("boundary RMS (mm)", 3, "min"),
    },
    "artefact": {
        "roi_std": Metric("ROI std (HU)", 1, "min"),
        "cupping": Metric("excess cupping (points)", 2, "min"),
        "streak": Metric("streak (HU)", 1, "min"),
        "rmse": Metric("RMSE (HU)", 1, "min"),
        "rmse_near": Metric("RMSE ≤ 5 mm (HU)", 1, "min"),
        "rmse_far": Metric("RMSE > 5 mm (HU)", 1, "min"),
    },
    "projection": {
        "noise_free/body": Metric("RMSE P", 4, "min"),
        "noise_free/outside": Metric("RMSE P, outside trace", 4, "min"),
        "noise_free/trace": Metric("RMSE P, in trace", 3, "min"),
        "effective/outside": Metric("RMSE effective, outside trace", 4, "min"),
        "effective/trace": Metric("RMSE effective, in trace", 3, "min"),
        "50kev/outside": Metric("RMSE 50 keV, outside trace", 4, "min"),
        "50kev/trace": Metric("RMSE 50 keV, in trace", 3, "min"),
    },
    "against": {
        "over_fdk": Metric("over FDK (dB)", 2, "max"),
        "over_nmar": Metric("over NMAR (dB)", 2, "max"),
    },
    "anchored": {
        "tissue/rmse": Metric("s tissue RMSE", 3, "min"),
        "tissue/ssim3d": Metric("s tissue 1 − SSIM3D", 3, "min"),
        "aligned/rmse": Metric("s aligned RMSE", 3, "min"),
        "artefact/streak": Metric("s streak", 3, "min"),
        "artefact/rmse_near": Metric("s RMSE ≤ 5 mm", 3, "min"),
    },
    "cost": {
        "wall": Metric("wall (s)", 2, "min"),
        "cpu": Metric("CPU (s)", 2, "min"),
        "peak_bytes": Metric("peak (MiB)", 0, "min", 1 / 2**20),
        "view_updates": Metric("view updates", 0),
        "warm_up": Metric("warm-up (s)", 2),
    },
}
