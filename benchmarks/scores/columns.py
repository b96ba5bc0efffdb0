"""What the tables show: the metrics of each protocol in order, with decimals and which way is better."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Column:
    """How a metric is shown: title, decimals, which way is better ("max", "min", "one" = nearest 1), and a factor."""

    title: str
    digits: int
    better: str = ""
    scale: float = 1.0


_PSNR, _SSIM = Column("PSNR3D (dB)", 2, "max"), Column("SSIM3D", 3, "max")

COLUMNS: dict[str, dict[str, Column]] = {
    "tissue": {"psnr3d": _PSNR, "ssim3d": _SSIM},
    "aligned": {"psnr3d": _PSNR, "ssim3d": _SSIM, "gain": Column("gain", 3)},
    "aligned_50kev": {"psnr3d": _PSNR, "ssim3d": _SSIM, "gain": Column("gain", 3)},
    "paper": {
        "psnr3d": _PSNR,
        "ssim3d": _SSIM,
        "psnr3d_full_gtmax": Column("psnr3d_full_gtmax", 2, "max"),
        "psnr3d_r2": Column("psnr3d_r2", 2, "max"),
        "ssim3d_r2": Column("ssim3d_r2", 3, "max"),
        "ssim3d_naf": Column("ssim3d_naf", 3, "max"),
    },
    "metal": {
        "core_ratio": Column("core ratio", 3, "one"),
        "dice": Column("Dice", 3, "max"),
        "boundary_rms": Column("boundary RMS (mm)", 3, "min"),
    },
    "artefact": {
        "roi_std": Column("ROI std (HU)", 1, "min"),
        "cupping": Column("excess cupping (points)", 2, "min"),
        "streak": Column("streak (HU)", 1, "min"),
        "rmse": Column("RMSE (HU)", 1, "min"),
        "rmse_near": Column("RMSE ≤ 5 mm (HU)", 1, "min"),
        "rmse_far": Column("RMSE > 5 mm (HU)", 1, "min"),
    },
    "projection": {
        "noise_free/body": Column("RMSE P", 4, "min"),
        "noise_free/outside": Column("RMSE P, outside trace", 4, "min"),
        "noise_free/trace": Column("RMSE P, in trace", 3, "min"),
        "effective/outside": Column("RMSE effective, outside trace", 4, "min"),
        "effective/trace": Column("RMSE effective, in trace", 3, "min"),
        "50kev/outside": Column("RMSE 50 keV, outside trace", 4, "min"),
        "50kev/trace": Column("RMSE 50 keV, in trace", 3, "min"),
    },
    "against": {
        "over_fdk": Column("over FDK (dB)", 2, "max"),
        "over_nmar": Column("over NMAR (dB)", 2, "max"),
    },
    "anchored": {
        "tissue/rmse": Column("s tissue RMSE", 3, "min"),
        "tissue/ssim3d": Column("s tissue 1 − SSIM3D", 3, "min"),
        "aligned/rmse": Column("s aligned RMSE", 3, "min"),
        "artefact/streak": Column("s streak", 3, "min"),
        "artefact/rmse_near": Column("s RMSE ≤ 5 mm", 3, "min"),
    },
    "cost": {
        "wall": Column("wall (s)", 2, "min"),
        "cpu": Column("CPU (s)", 2, "min"),
        "peak_bytes": Column("peak (MiB)", 0, "min", 1 / 2**20),
        "view_updates": Column("view updates", 0),
        "warm_up": Column("warm-up (s)", 2),
    },
}
