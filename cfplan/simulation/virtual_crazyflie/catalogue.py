"""The names of a Crazyflie's log variables and parameters in crazyflie-firmware 2026.08.

One group a line (indented lines go on): `group: type name name; type name`. Behind a parameter's name, `*` says that
it can be stored and `!` that it can only be read.
"""

LOG_VARIABLES = """
acc: f32 x y z
accSec: f32 x y z
activeMarker: u8 btSns i2cOk
baro: f32 asl temp pressure
bcCam: u8 driverState linkState txCredit rxSlots controlDone schemaCount; u16 payload rxFrames txFrames rxBytes
  txBytes crcErrors faults txFlushes; i32 lastErr
CkCorrection: f32 minNoise maxNoise minSpec maxSpec actualValue candidate
colAv: u32 latency
colorLedBot: u8 deckTemp throttlePct; u16 ledCurR ledCurG ledCurB ledCurW
colorLedTop: u8 deckTemp throttlePct; u16 ledCurR ledCurG ledCurB ledCurW
controller: f32 cmd_thrust cmd_roll cmd_pitch cmd_yaw r_roll r_pitch r_yaw accelz actuatorThrust roll pitch yaw
  rollRate pitchRate yawRate; i16 ctr_yaw
crtp: u16 rxRate txRate
ctrlINDI: f32 cmd_thrust cmd_roll cmd_pitch cmd_yaw r_roll r_pitch r_yaw u_act_dyn_p u_act_dyn_q u_act_dyn_r du_p
  du_q du_r ang_accel_ref_p ang_accel_ref_q ang_accel_ref_r uf_p uf_q uf_r Omega_f_p Omega_f_q Omega_f_r n_p n_q n_r
ctrlLee: f32 KR_x KR_y KR_z Kw_x Kw_y Kw_z Kpos_Px Kpos_Py Kpos_Pz Kpos_Dx Kpos_Dy Kpos_Dz thrustSi torquex torquey
  torquez rpyx rpyy rpyz rpydx rpydy rpydz error_posx error_posy error_posz error_velx error_vely error_velz omegax
  omegay omegaz omegarx omegary omegarz
ctrlMel: f32 cmd_thrust cmd_roll cmd_pitch cmd_yaw r_roll r_pitch r_yaw accelz zdx zdy zdz i_err_x i_err_y i_err_z
ctrltarget: f32 x y z vx vy vz ax ay az roll pitch yaw thrust; u8 mode_x mode_y mode_z mode_roll mode_pitch mode_yaw
  mode_quat
ctrltargetZ: i16 x y z vx vy vz ax ay az
deckStatus: u8 bcLighthouse4 bcLoco
DTR_P2P: u8 rx_state tx_state
ext_pos: f32 X Y Z
extrx: f32 thrust roll pitch rollRate pitchRate yawRate zVel; u8 AltHold Arm
extrx_raw: u16 ch0 ch1 ch2 ch3 ch4 ch5 ch6 ch7
gps: i32 lat lon nsat fix; f32 hMSL hAcc
gyro: i16 xRaw yRaw zRaw; f32 xVariance yVariance zVariance x y z
gyroSec: f32 x y z
health: f32 motorVarXM1 motorVarYM1 motorVarXM2 motorVarYM2 motorVarXM3 motorVarYM3 motorVarXM4 motorVarYM4
  batterySag; u8 motorPass batteryPass; u16 motorTestCount
kalman: f32 stateX stateY stateZ statePX statePY statePZ stateD0 stateD1 stateD2 varX varY varZ varPX varPY varPZ
  varD0 varD1 varD2 q0 q1 q2 q3
kalman_pred: f32 predNX predNY measNX measNY
lighthouse: u8 validAngles comSync status; f32 rawAngle0x rawAngle0y rawAngle1x rawAngle1y angle0x angle0y angle1x
  angle1y rawAngle0xlh2 rawAngle0ylh2 rawAngle1xlh2 rawAngle1ylh2 angle0x_0lh2 angle0y_0lh2 angle1x_0lh2
  angle1y_0lh2 x y z delta; u16 bsAvailable bsReceive bsActive bsCalUd bsCalCon bsGeoVal bsCalVal
loadcell: i32 rawWeight; f32 weight
loco: u8 mode
locSrv: f32 x y z qx qy qz qw
locSrvZ: u16 tick
mag: f32 x y z
maxSonar: u32 distance accuracy
memTst: u32 errCntW
motion: u8 motion maxRaw minRaw Rawsum outlierCount squal; i16 deltaX deltaY; u16 shutter; f32 std
motor: u16 m1 m2 m3 m4 m1_rpm m2_rpm m3_rpm m4_rpm; i32 m1req m2req m3req m4req
navFilter: f32 posX posY posZ accX accY accZ omegaX omegaY omegaZ Phi Theta Psi Px Pvx Pattx range procTimeFilter;
  u32 nanCounter; u8 recAnchorId
oa: u16 front back up left right
outlierf: i32 lhWin bucket0 bucket1 bucket2 bucket3 bucket4; f32 accLev errD
pid_attitude: f32 roll_outP roll_outI roll_outD roll_outFF pitch_outP pitch_outI pitch_outD pitch_outFF yaw_outP
  yaw_outI yaw_outD yaw_outFF
pid_rate: f32 roll_outP roll_outI roll_outD roll_outFF pitch_outP pitch_outI pitch_outD pitch_outFF yaw_outP
  yaw_outI yaw_outD yaw_outFF
pm: f32 vbat extVbat extCurr chargeCurrent temp; u16 vbatMV extVbatMV; i8 state; u8 batteryLevel
posCtl: f32 targetVX targetVY targetVZ targetX targetY targetZ bodyVX bodyVY bodyX bodyY Xp Xi Xd Xff Yp Yi Yd Yff
  Zp Zi Zd Zff VXp VXi VXd VXff VYp VYi VYd VYff VZp VZi VZd VZff
posCtrlIndi: f32 posRef_x posRef_y posRef_z velS_x velS_y velS_z velRef_x velRef_y velRef_z angS_roll angS_pitch
  angS_yaw angF_roll angF_pitch angF_yaw accRef_x accRef_y accRef_z accS_x accS_y accS_z accF_x accF_y accF_z
  accFT_x accFT_y accFT_z accErr_x accErr_y accErr_z phi_tilde theta_tilde T_tilde T_inner T_inner_f T_incremented
  cmd_phi cmd_theta
posEstAlt: f32 estimatedZ estVZ velocityZ
proximity: u32 distance distanceAvg distanceMed accuracy
radio: u8 rssi isConnected; u16 numRxBc numRxUc
range: u16 front back up left right zrange
ranging: u16 state; f32 distance0 distance1 distance2 distance3 distance4 distance5 distance6 distance7 pressure0
  pressure1 pressure2 pressure3 pressure4 pressure5 pressure6 pressure7
ring: f32 fadeTime
rpm: u16 m1 m2 m3 m4
sensfusion6: f32 qw qx qy qz gravityX gravityY gravityZ accZbase; u8 isInit isCalibrated
sensorFilter: f32 dxPx dyPx dxPxPred dyPxPred distPred distMeas baroHeight innoChFlow_x innoChFlow_y innoChTof
  distTWR
stabilizer: f32 roll pitch yaw thrust; u32 intToOut
stateEstimate: f32 x y z vx vy vz ax ay az roll pitch yaw qx qy qz qw
stateEstimateZ: i16 x y z vx vy vz ax ay az rateRoll ratePitch rateYaw; u32 quat
supervisor: u16 info; f32 accNorm
sys: u8 canfly isFlying isTumbled; i8 testLogParam
tdoa2: f32 cc0 cc1 cc2 cc3 cc4 cc5 cc6 cc7
tdoa3: f32 hmDist
tdoaEngine: f32 cc tdoa; u16 tof
twr: u8 rangingSuccessRate0 rangingPerSec0 rangingSuccessRate1 rangingPerSec1 rangingSuccessRate2 rangingPerSec2
  rangingSuccessRate3 rangingPerSec3 rangingSuccessRate4 rangingPerSec4 rangingSuccessRate5 rangingPerSec5
  rangingSuccessRate6 rangingPerSec6 rangingSuccessRate7 rangingPerSec7
"""

PARAMETERS = """
activeMarker: u8 front* back* left* right* mode* poll canStart
colAv: u8 enable; f32 ellipsoidX ellipsoidY ellipsoidZ bboxMinX bboxMinY bboxMinZ bboxMaxX bboxMaxY bboxMaxZ horizon
  maxSpeed sidestepThrsh vorTol; i32 maxPeerLocAge vorIters
colorLedBot: u32 wrgb8888; u8 brightCorr
colorLedTop: u32 wrgb8888; u8 brightCorr
commander: u8 enHighLevel
cpu: u16 flash!; u32 id0! id1! id2!
crtpsrv: u16 echoDelay
ctrlAtt: f32 tau_xy zeta_xy tau_z zeta_z tau_rp mixing_factor coll_fairness
ctrlINDI: f32 thrust_threshold bound_ctrl_input g1_p g1_q g1_r g2 ref_err_p ref_err_q ref_err_r ref_rate_p
  ref_rate_q ref_rate_r act_dyn_p act_dyn_q act_dyn_r filt_cutoff filt_cutoff_r; u8 outerLoopActive
ctrlLee: f32 KR_x KR_y KR_z KI_x KI_y KI_z Kw_x Kw_y Kw_z J_x J_y J_z Kpos_Px Kpos_Py Kpos_Pz Kpos_P_limit Kpos_Dx
  Kpos_Dy Kpos_Dz Kpos_D_limit Kpos_Ix Kpos_Iy Kpos_Iz Kpos_I_limit mass
ctrlMel: f32 kp_xy* kd_xy* ki_xy* i_range_xy* kp_z* kd_z* ki_z* i_range_z* mass* massThrust* kR_xy* kR_z* kw_xy*
  kw_z* ki_m_xy* ki_m_z* kd_omega_rp* i_range_m_xy* i_range_m_z*
deck: u8 bcActiveMarker! bcAI! bcCam! bcCamLink! bcBuzzer! bcColorLedBot! bcColorLedTop! cpxOverUART2! bcFlow!
  bcFlow2! bcGTGPS! bcLedRing! bcLhTester! bcLighthouse4! bcLoadcell! bcDWM1000! bcLoco! bcMultiranger! bcOA!
  bcServo! bcUSD! bcZRanger! bcZRanger2!
deckTest: u8 bcColorLedBot! bcColorLedTop!
flightmode: u8 althold poshold posSet yawMode stabModeRoll stabModePitch stabModeYaw
flowdeck: f32 flowdeckPos_x* flowdeckPos_y* flowdeckPos_z*
health: u8 startPropTest startBatTest; f32 propTestThreshold* propTestThresholdL*; u16 propTestPWMRatio*
  batTestPWMRatio*
hlCommander: f32 vtoff vland; u8 groupmask
imu_sensors: u8 BMP3XX! BoschGyrSel BoschAccSel BMM150! BMP285!; f32 imuPhi* imuTheta* imuPsi*
kalman: u8 resetEstimation robustTdoa robustTwr; f32 pNAcc_xy* pNAcc_z* pNVel* pNPos* pNAtt* mNBaro*
  mNGyro_rollpitch* mNGyro_yaw* initialX initialY initialZ initialYaw dragB_x* dragB_y* dragB_z* cop_x* cop_y*
  cop_z* maxPos maxVel
led: u8 bitmask
led_deck_ctrl: u32 rgb888
lighthouse: u8 method bsCalibReset systemType fwdToEstimator enLhRawStream; u16 bsAvailable! lh2maxRate; f32
  sweepStd sweepStd2
loadcell: u8 enable sampleRate channel; f32 a b
loco: u8 mode fwdToEstimator
locSrv: u8 enRangeStreamFP32 enLhAngleStream enLhMtchStm maxTimeLhMtchStm minBsLhMtchStm; f32 extPosStdDev
  extQuatStdDev
memTst: u8 resetW
motion: u8 disable adaptive; f32 flowStdFixed*
motorPowerSet: u8 enable; u16 m1 m2 m3 m4
multiranger: u16 filterMask
pid_attitude: f32 roll_kp* roll_ki* roll_kd* roll_kff* pitch_kp* pitch_ki* pitch_kd* pitch_kff* yaw_kp* yaw_ki*
  yaw_kd* yaw_kff* yawMaxDelta* attFiltCut*; i8 attFiltEn*
pid_rate: f32 roll_kp* roll_ki* roll_kd* roll_kff* pitch_kp* pitch_ki* pitch_kd* pitch_kff* yaw_kp* yaw_ki* yaw_kd*
  yaw_kff* omxFiltCut* omyFiltCut* omzFiltCut*; i8 rateFiltEn*
pm: f32 lowVoltage* criticalLowVoltage*
powerDist: u32 idleThrust*
posCtlPid: f32 xKp* xKi* xKd* xKff* yKp* yKi* yKd* yKff* zKp* zKi* zKd* zKff* rLimit* pLimit* xVelMax* yVelMax*
  zVelMax*; u16 thrustBase* thrustMin*
posCtrlIndi: f32 K_xi_x K_xi_y K_xi_z K_dxi_x K_dxi_y K_dxi_z pq_clamping
posEstAlt: f32 estAlphaAsl* estAlphaZr* velFactor* velZAlpha* vAccDeadband*
ring: u8 effect* solidRed solidGreen solidBlue headlightEnable; u32 neffect! fadeColor; f32 emptyCharge fullCharge
  fadeTime
sensfusion6: f32 beta kp* ki* baseZacc
servo: u16 servoMINus* servoMAXus*; u8 servoRange* servoIdle* servoAngle
sound: u8 effect*; u32 neffect!; u16 freq
stabilizer: u8 estimator controller stop
supervisor: u8 infdmp tmblChckEn*; u16 prefltTimeout* landedTimeout* spinupTimeout*; f32 crashDetectGs*
syslink: u8 probe
system: u8 highlight storageStats storageReformat taskDump assertInfo testLogParam doAssert; i8 selftestPassed!
tdoa2: f32 stddev
tdoa3: f32 stddev twrStd; u8 hmId hmTdoa hmTwr hmTwrTXPos hmTwrEstPos hmAnchLog; u32 hmTofAge
tdoaEngine: u8 logId logOthrId matchAlgo
usd: u8 canLog! logging
usec: u8 reset
velCtlPid: f32 vxKp* vxKi* vxKd* vxKFF* vyKp* vyKi* vyKd* vyKFF* vzKp* vzKi* vzKd* vzKFF*
"""

# Parameters and log variables that came with a version of the firmware.
CAME_WITH: dict[tuple[int, ...], tuple[str, ...]] = {
    (2024, 10): ("supervisor.landedTimeout", "supervisor.tmblChckEn", "hlCommander.groupmask"),
    (2025, 2): ("supervisor.prefltTimeout",),
    (2026, 4): (
        "kalman.dragB_x", "kalman.dragB_y", "kalman.dragB_z", "kalman.cop_x", "kalman.cop_y", "kalman.cop_z",
    ),
    (2026, 8): (
        "supervisor.spinupTimeout", "supervisor.crashDetectGs", "ctrltarget.thrust", "ctrltarget.mode_x",
        "ctrltarget.mode_y", "ctrltarget.mode_z", "ctrltarget.mode_roll", "ctrltarget.mode_pitch",
        "ctrltarget.mode_yaw", "ctrltarget.mode_quat",
    ),
}  # fmt: skip


def lacking(version: tuple[int, ...]) -> frozenset[str]:
    """Return the names that a firmware does not have."""
    return frozenset(name for since, names in CAME_WITH.items() if version < since for name in names)
