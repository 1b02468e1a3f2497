def calibrate_by_robot(footage, cfg, progress):
    raise NotImplementedError
